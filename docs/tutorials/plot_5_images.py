"""
5. Policies that see images
===========================

With cameras only the observation changes: a vector next to images, nested under one key. An encoder
in front of the network reads it. The task of this tutorial draws its own pictures, so that it
runs without a simulator: a gripper, seen from above, has to reach a part whose position only the
camera shows.
"""

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from warmprior import (
    FlowMatchingLoss,
    ImageEncoder,
    PastPrior,
    PreconditionedNetwork,
    SourceMoments,
    VelocityMLP,
    VisionNetwork,
    WarmPriorActor,
    policy_transforms,
    window_replay_buffer,
)

torch.manual_seed(0)

# %%
# An environment with a camera
# ----------------------------
# The observation has two entries: ``"state"``, where the gripper is, and ``"camera"``, an image of
# bytes, channels first. Robots' environments (:class:`~warmprior.envs.RobosuiteEnv` behind
# :class:`~warmprior.CameraImages`) have the same form.

SIZE, STEPS = 32, 20


def draw(gripper, part):
    """Images ``[n, 3, 32, 32]``: the gripper red, the part green."""
    line = torch.linspace(-1.2, 1.2, SIZE)
    images = torch.full((len(gripper), 3, SIZE, SIZE), 235, dtype=torch.uint8)
    for place, color in ((part, (40, 160, 60)), (gripper, (210, 50, 40))):
        x = (line - place[:, :1]).square()
        y = (line.flip(0) - place[:, 1:]).square()
        covered = x[:, None, :] + y[:, :, None] < 0.16**2
        for channel, value in enumerate(color):
            images[:, channel][covered] = value
    return images


class ReachEnv(EnvBase):
    """``n`` grippers on tables; an action moves one by at most 0.12."""

    def __init__(self, n):
        super().__init__(batch_size=[n])
        self.observation_spec = Composite(
            observation=Composite(
                state=Unbounded((n, 2)),
                camera=Bounded(0, 255, (n, 3, SIZE, SIZE), dtype=torch.uint8),
                shape=[n],
            ),
            success=Categorical(2, shape=(n, 1), dtype=torch.bool),
            **self._carried(n),
            shape=[n],
        )
        self.state_spec = Composite(self._carried(n), shape=[n])
        self.action_spec = Bounded(-1, 1, (n, 2))
        self.reward_spec = Unbounded((n, 1))

    def _carried(self, n):
        places = {name: Unbounded((n, 2)) for name in ("gripper", "part")}
        return places | {"step": Unbounded((n, 1), dtype=torch.int64)}

    def _outcome(self, gripper, part, step):
        observation = {"state": gripper, "camera": draw(gripper, part)}
        outcome = {"observation": TensorDict(observation, self.batch_size)}
        outcome |= {"gripper": gripper, "part": part, "step": step}
        outcome["success"] = (gripper - part).norm(
            dim=-1, keepdim=True
        ) < 0.12
        return outcome | {"done": step >= STEPS, "terminated": step >= STEPS}

    def _reset(self, tensordict, **kwargs):
        gripper, part = (torch.rand(2, *self.batch_size, 2) * 2 - 1).unbind(0)
        gripper[:, 1] = gripper[:, 1].abs() - 1  # below
        part[:, 1] = part[:, 1].abs()  # above
        step = torch.zeros(*self.batch_size, 1, dtype=torch.int64)
        return TensorDict(self._outcome(gripper, part, step), self.batch_size)

    def _step(self, tensordict):
        gripper = (
            tensordict["gripper"] + 0.12 * tensordict["action"].clamp(-1, 1)
        ).clamp(-1, 1)
        outcome = self._outcome(
            gripper, tensordict["part"], tensordict["step"] + 1
        )
        return TensorDict(
            outcome | {"reward": outcome["success"].float()}, self.batch_size
        )

    def _set_seed(self, seed):
        torch.manual_seed(seed)


# %%
# Demonstrations
# --------------
# The demonstrator knows where the part is, and goes there. The dataset holds contiguous steps, as
# always; the images stay bytes. (Large files keep them on disk: ``storage="memmap"`` of
# the readers.)


def demonstrator(tensordict):
    way = (tensordict["part"] - tensordict["gripper"]) / 0.12
    return tensordict.set(
        "action", way / way.norm(dim=-1, keepdim=True).clamp_min(1.0)
    )


rollout = ReachEnv(120).rollout(STEPS, demonstrator)
demos = rollout.select("observation", "action").reshape(-1)
demos["episode"] = torch.arange(120).repeat_interleave(STEPS)
print(demos)

figure, axes = plt.subplots(1, 5, figsize=(9, 2.1))
for axis, step in zip(axes, (0, 3, 6, 9, 12), strict=True):
    axis.imshow(demos["observation", "camera"][step].permute(1, 2, 0))
    axis.set(title=f"step {step}", xticks=[], yticks=[])
figure.suptitle("What the policy sees: gripper red, part green")
plt.show()

# %%
# The network
# -----------
# :class:`~warmprior.ImageEncoder` has one small network per camera (``backbone="resnet18"`` is the
# paper's) and puts the features behind the vector. In training it cuts out a random window of
# ``crop_size`` pixels, in evaluation the middle one, so that the policy does not memorise
# pixels. :class:`~warmprior.VisionNetwork` puts it in front of any velocity network, and runs it
# once per decision, however many integration steps follow. Everything else is the same as without images.


def train(demos, iterations=700):
    torch.manual_seed(0)
    prior = PastPrior(chunk_length=4, sigma=0.5)
    windows = window_replay_buffer(
        demos, prior, batch_size=64, observation_steps=1
    )
    encoder = ImageEncoder(
        ["camera"],
        state_dim=2,
        image_size=SIZE,
        crop_size=28,
        backbone="small",
    )
    network = VisionNetwork(
        encoder,
        VelocityMLP(
            2, encoder.observation_dim, 4, observation_steps=1, hidden_dim=64
        ),
    )
    network = PreconditionedNetwork(
        network, moments=SourceMoments.fit(windows, prior)
    )
    actor = WarmPriorActor(network, prior, nfe=1, clip=1.0)
    loss_module = FlowMatchingLoss(actor)
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, iterations
    )
    losses = []
    for _ in range(iterations):
        optimizer.zero_grad()
        loss = loss_module(windows.sample())["loss_flow_matching"]
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    return actor.eval(), losses


seeing, losses = train(demos)

blank = demos.clone()
blank["observation", "camera"].fill_(235)
blind, blind_losses = train(blank, iterations=300)

# %%
# ``blind`` is the same policy trained on blank images. Train one whenever you train a policy on
# images: if it solves the task as well, the images are not what your policy uses.
#
# Acting
# ------


def play(actor, camera=True):
    env = ReachEnv(200)
    env = TransformedEnv(
        env, policy_transforms(actor.prior, observation_steps=1)
    )

    def policy(tensordict):
        if not camera:
            tensordict["observation", "camera"].fill_(235)
        return actor(tensordict)

    torch.manual_seed(1)
    with torch.no_grad():
        return env.rollout(STEPS, policy)


figure, axes = plt.subplots(1, 3, figsize=(10, 3.4))
for name, curve in (
    ("with images", losses),
    ("images blanked", blind_losses),
):
    means = torch.tensor(curve).view(-1, 10).mean(1)
    axes[0].plot(torch.arange(len(means)) * 10 + 5, means, label=name)
axes[0].set(
    title="Training", xlabel="iterations", ylabel="flow-matching loss"
)
axes[0].set_ylim(bottom=0)
axes[0].legend()
for axis, name, played in (
    (axes[1], "With images", play(seeing)),
    (axes[2], "Images blanked", play(blind, camera=False)),
):
    solved = played["next", "success"].any(1).float().mean()
    for i in range(12):
        path = torch.cat(
            [played["gripper"][i], played["next", "gripper"][i, -1:]]
        )
        axis.plot(*path.T, ".-", lw=1, ms=4, color=f"C{i % 10}")
        axis.plot(
            *played["part"][i, 0],
            "*",
            ms=11,
            color=f"C{i % 10}",
            mec="black",
            mew=0.5,
        )
    axis.set(title=f"{name}: {solved:.0%} reach the part", aspect="equal")
    axis.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), xlabel="x")
axes[1].set_ylabel("y")
plt.show()

# %%
# Each star is a part, in the color of the path to it; a dot is a decision, of four actions each.
# What to notice: with images the paths lead to their parts, and their slight overshoot is that of
# four actions decided at once. The blind policy has only learned what all demonstrations have in
# common: to go up.
#
# Robots
# ------
# The benchmark does the same on a simulated robot:
#
# .. code-block:: console
#
#    python benchmarks/robomimic.py --obs image
#
# Lift from two cameras of 48 x 48 pixels, 100 scripted demonstrations, 3,000 iterations of batch
# 64, one seed: policies from the Gaussian source, WP-Past and WP-Preview solve 25 of 25 episodes, at
# NFE 3 and at NFE 1, and an untrained one solves none (15 minutes on two cores;
# :doc:`lab notes </notes/evidence>`). :doc:`/images` says how demonstrations get their images, and what
# larger encoders need.
