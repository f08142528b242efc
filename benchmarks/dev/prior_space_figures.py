"""What reinforcement learning in source space costs, beside what it is built on."""

from __future__ import annotations

import statistics
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs import TransformedEnv

from warmprior import (
    DSRLNALoss,
    PastPrior,
    PriorAnchor,
    PriorDecoder,
    ResidualSampler,
    VelocityMLP,
    WarmPriorActor,
    keys,
    make_prior_space_actor,
    make_prior_space_critic,
    policy_transforms,
)
from warmprior.envs import RobosuiteEnv

D_O, D_A, H, TO, BATCH, HIDDEN = 23, 7, 8, 2, 256, 256
SIZES = {
    "action_dim": D_A,
    "observation_dim": D_O,
    "prediction_length": H,
    "observation_steps": TO,
    "hidden_dim": HIDDEN,
}


class NoDecoder(PriorDecoder):
    """Takes the source for the chunk: everything a decoder does but the flow."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        noise = tensordict.get(keys.ANCHOR) + tensordict.get(keys.DELTA)
        return tensordict.set(keys.NOISE, noise).set(keys.CHUNK, noise)


def frozen_policy(observation_dim: int = D_O) -> WarmPriorActor:
    torch.manual_seed(0)
    network = VelocityMLP(D_A, observation_dim, H, TO, hidden_dim=384)  # that of the quick preset
    return WarmPriorActor(network, PastPrior(H), nfe=1)


class Update:
    """One round of updates of DSRL-NA on one batch: two of the critics, one distillation."""

    def __init__(self, decoder: PriorDecoder, batch: TensorDict) -> None:
        torch.manual_seed(0)
        self.batch = batch
        self.loss = DSRLNALoss(
            make_prior_space_actor(**SIZES, delta=decoder.delta),
            make_prior_space_critic(**SIZES, in_keys=(keys.OBSERVATION, keys.CHUNK)),
            make_prior_space_critic(**SIZES, delta=decoder.delta),
            decoder,
            noise_critic_steps=1,
        )
        self.loss.make_value_estimator(gamma=0.99)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=3e-4)

    def __call__(self) -> None:
        for compute in self.loss.schedule(updates=2):
            losses = compute(self.batch)
            self.optimizer.zero_grad()
            sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
            self.optimizer.step()


def transitions() -> TensorDict:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(BATCH, *shape, generator=generator) * 2 - 1

    def state() -> dict[Any, Any]:
        return {"observation": draw(TO, D_O), keys.ANCHOR: draw(H, D_A)}

    flags = {name: torch.zeros(BATCH, 1, dtype=torch.bool) for name in ("done", "terminated")}
    after = state() | flags | {"reward": draw(1)}
    data = TensorDict({**state(), keys.CHUNK: draw(H, D_A)}, [BATCH])
    data["next"] = TensorDict(after, [BATCH])
    data["next", keys.EXECUTED] = torch.full((BATCH, 1), H)
    return data


def decoding(clock: Any) -> dict[str, dict[str, float]]:
    """By NFE: updates per second over those of the same networks without the flow, and its share of time."""
    batch, actor, found = transitions(), frozen_policy(), {}
    plain = Update(NoDecoder(actor, delta=0.5), batch)
    for nfe in (1, 3, 9):
        whole, rest = clock.times(Update(PriorDecoder(actor, delta=0.5, nfe=nfe), batch), plain)
        ratio = statistics.median(b / a for a, b in zip(whole, rest, strict=True))
        found[str(nfe)] = {"updates_over_networks": ratio, "decoding_share": 1.0 - ratio}
    return found


class Collection:
    """Decisions in an environment, one after the other."""

    def __init__(self, env: Any, policy: TensorDictModuleBase) -> None:
        self.env, self.policy = env, policy

    def restart(self) -> None:
        self.env.set_seed(0)
        self.data = self.env.reset()

    def __call__(self) -> None:
        with torch.no_grad():
            _, self.data = self.env.step_and_maybe_reset(self.policy(self.data))


class BareSteps:
    """As many control steps of the bare environment, with the same actions' cost."""

    def __init__(self, env: Any) -> None:
        self.env, self.action = env, torch.zeros(D_A)

    def restart(self) -> None:
        self.env.set_seed(0)
        self.data = self.env.reset()

    def __call__(self) -> None:
        for _ in range(H):
            data = self.data.set("action", self.action)
            _, self.data = self.env.step_and_maybe_reset(data)


def collection_over_env(clock: Any) -> float:
    """Time of collecting a control step in source space over that of a bare ``RobosuiteEnv``, at NFE 1."""
    bare = RobosuiteEnv(task="lift")
    actor = frozen_policy(bare.observation_spec["observation"].shape[-1])
    decoder = PriorDecoder(actor, delta=0.5)
    transforms = policy_transforms(actor.prior, observation_steps=TO)
    transforms.append(PriorAnchor(actor))
    whole = Collection(
        TransformedEnv(RobosuiteEnv(task="lift"), transforms),
        TensorDictSequential(ResidualSampler(decoder), decoder),
    )
    steps = BareSteps(bare)

    def restart() -> None:
        whole.restart()
        steps.restart()

    return clock.ratio(whole, steps, calls=20, before=restart)
