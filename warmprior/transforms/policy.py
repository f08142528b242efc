"""The transforms between a base environment and a policy, in their order."""

from __future__ import annotations

from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import uncompiled
from warmprior.modules.normalize import Normalizer
from warmprior.modules.prior import Prior
from warmprior.transforms.chunk import ChunkStep, Measures
from warmprior.transforms.delay import InferenceDelay, check_delay, usual_execute
from warmprior.transforms.history import ActionHistory, HistoryObservation
from warmprior.transforms.normalize import normalizing_transforms
from warmprior.transforms.stack import ObservationStack


class PolicyEnv(TransformedEnv):
    """An environment with a policy's transforms; its own stay inside, as TorchRL unwraps no subclass."""

    # TorchRL draws no random action through transforms that change it if a class inside has a method for it.
    rand_action = EnvBase.rand_action


def policy_transforms(
    policy: WarmPriorActor | Prior,
    *,
    normalizer: Normalizer | None = None,
    actions: Transform | None = None,
    images: Transform | None = None,
    observation_steps: int | None = None,
    execute: int | None = None,
    delay: int | None = None,
    gamma: float = 1.0,
    see_history: bool | None = None,
    observation_key: NestedKey | None = None,
    action_key: NestedKey = keys.ACTION,
    success: NestedKey = keys.SUCCESS,
    by_success: bool = False,
    measures: Measures | None = None,
) -> Compose:
    """Return the transforms between an environment and a :class:`~warmprior.WarmPriorActor`.

    They convert actions to the environment's own, add camera images, (de)normalise, stack the last ``To``
    observations, execute chunks (:class:`ChunkStep`), write the history (:class:`ActionHistory`), and on
    request show it to the network (:class:`HistoryObservation`) and delay chunks (:class:`InferenceDelay`),
    in this order. They work around a single environment, and inside or outside batched ones (with images,
    inside only).

    Args:
        policy: the policy, or its prior (only its lengths are used).
        normalizer: the normaliser of the training data; the policy's by default. Pass the policy's prior
            instead of the policy if the environment is already normalised.
        actions: transform that converts the policy's actions, in raw units, to the environment's, such as
            :class:`AbsoluteActions`; it is copied.
        images: transform that adds images to observations, such as :class:`CameraImages`; it is copied.
        observation_steps: ``To``; by default that of the policy's network, or 2.
        execute: actions executed per decision; by default ``H`` (of a ``warm_flow`` policy its
            ``n_action_steps``); with a ``delay``, at most ``P - delay``.
        delay: control steps until a chunk takes effect, see :class:`InferenceDelay`. By default 0 if the
            policy has :class:`~warmprior.RealTimeChunking`; otherwise no delay is written.
        gamma: discount per control step inside a chunk.
        see_history: True if the network sees the last actions; by default as in the policy.
        observation_key: key of the observation; by default the policy's, like the keys of history and chunk.
        action_key: key of the environment's action.
        success: see :class:`ChunkStep`.
        by_success: see :class:`ChunkStep`.
        measures: see :class:`ChunkStep`.

    Raises:
        TypeError: if ``policy`` is neither a policy nor a prior.
        ValueError: if the normaliser lacks the action, or numbers are inconsistent.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import PreviewPrior, VelocityMLP, WarmPriorActor, policy_transforms
        >>> actor = WarmPriorActor(VelocityMLP(1, 3, prediction_length=8), PreviewPrior(4))
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), policy_transforms(actor))
        >>> env.reset()["observation"].shape
        torch.Size([2, 3])
    """
    policy = uncompiled(policy)
    prior, history_key, chunk_key = policy, keys.HISTORY, keys.CHUNK
    if isinstance(policy, WarmPriorActor):
        prior, observed = policy.prior, policy.observation_key
        history_key, chunk_key = policy.history_key, policy.tensor_keys["chunk_key"]
        sees_history = policy.sees_history  # then the stack writes the observation under its default key
        normalizer = normalizer or policy.normalizer
        observation_key = observation_key or (None if sees_history else observed)
        see_history = sees_history if see_history is None else see_history
        if observation_steps is None:
            observation_steps = getattr(uncompiled(policy.network), "observation_steps", None)
        if delay is None and policy.ode.guidance is not None:
            delay = 0  # guidance reads the delay's key
    if not isinstance(prior, Prior):
        raise TypeError(f"policy_transforms takes a WarmPriorActor or a Prior, got {type(prior).__name__}")
    observation_steps = 2 if observation_steps is None else observation_steps
    observation_key = observation_key or keys.OBSERVATION
    if normalizer is not None:
        normalizer.check_has(action_key)
    execute = usual_execute(policy, prior, delay or 0) if execute is None else execute
    late: list[Transform] = []
    if see_history:
        late.append(HistoryObservation(observation_key=observation_key, history_key=history_key))
    if delay is not None:
        check_delay(delay, execute, prior.prediction_length)
        late.append(InferenceDelay(delay, execute=execute, chunk_key=chunk_key, history_key=history_key))
    per_step = [transform.clone() for transform in (actions, images) if transform is not None]
    per_step += [] if normalizer is None else normalizing_transforms(normalizer, action_key)
    return Compose(
        *per_step,
        ObservationStack(observation_steps, observation_key=observation_key),
        ChunkStep(
            prior.chunk_length,
            execute=execute,
            prediction_length=prior.prediction_length,
            gamma=gamma,
            success=success,
            by_success=by_success,
            measures=measures,
            action_keys=[action_key],
            chunk_keys=[chunk_key],
        ),
        ActionHistory(prior.history_length, chunk_key=chunk_key, history_key=history_key),
        *late,
    )
