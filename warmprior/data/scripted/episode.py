"""One scripted demonstration: everything about it follows from its task, style and seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warmprior.data.scripted.motion import ArmRunner, Plan
from warmprior.data.scripted.operators import OPERATORS, SKILLED, Demonstrator
from warmprior.data.scripted.tasks_single import can, lift, square, stack
from warmprior.data.scripted.transport import transport
from warmprior.envs.control_loop import ControlLoop, StepLoop
from warmprior.envs.simulator import make_simulator, task_env_args
from warmprior.envs.tasks import get_task

PLANS: dict[str, Callable[[StepLoop, Demonstrator], list[Plan]]] = {
    "lift": lift,
    "can": can,
    "square": square,
    "stack": stack,
    "transport": transport,
}
_EXTRA_KEYS = ("eef_quat_site", "gripper_qvel", "joint_pos", "joint_vel")
_HOLD = 6  # steps that the task must stay solved for before the episode ends


@dataclass
class Episode:
    """A recorded demonstration of ``N`` steps.

    ``actions`` ``[N, d_a]`` in ``[-1, 1]``; ``states`` ``[N, 1 + nq + nv]``, the simulator before each;
    ``rewards`` ``[N]``, 1 where the action led to a solved state; ``observations`` ``[N + 1, ...]`` by name,
    the last row after the last action. All are float64.
    """

    seed: int
    operator: int
    level: str
    success: bool
    actions: np.ndarray
    states: np.ndarray
    rewards: np.ndarray
    observations: dict[str, np.ndarray]


def expert_loop(task: str) -> ControlLoop:
    """Make the simulation that a task's expert acts in."""
    spec = get_task(task)
    extra = (f"robot{i}_{key}" for i in range(spec.arms) for key in _EXTRA_KEYS)
    return ControlLoop(make_simulator(task_env_args(task)), (*spec.low_dim_keys, *extra))


def operator_of(style: str, seed: int) -> int:
    """Index of the operator who plays a seed: they take turns in ``mh`` data."""
    return seed % len(OPERATORS) if style == "mh" else 0


def run_episode(loop: StepLoop, task: str, style: str, seed: int) -> Episode:
    """Play one scripted episode in an :func:`expert_loop`; the same seed gives the same one.

    It ends six steps after the task is solved, when the plan is exhausted, or at the task's time limit.
    """
    spec = get_task(task)

    def observe(low_dim: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {key: value.astype(np.float64) for key, value in low_dim.items()}

    index = operator_of(style, seed)
    operator = OPERATORS[index] if style == "mh" else SKILLED
    # The first number keeps this stream apart from others that are seeded with the same integer.
    person = Demonstrator(operator, np.random.default_rng([7919, seed]))
    observations = [observe(loop.reset(seed))]
    runners = [ArmRunner(loop, arm, plan, person) for arm, plan in enumerate(PLANS[task](loop, person))]
    states, actions, rewards = [], [], []
    solved = 0
    for _ in range(spec.horizon(style)):
        states.append(loop.state())
        action = np.concatenate([runner.act() for runner in runners])
        low_dim, success = loop.step(action)
        actions.append(action)
        rewards.append(float(success))
        observations.append(observe(low_dim))
        solved = solved + 1 if success else 0
        if solved >= _HOLD or (not success and all(runner.given_up for runner in runners)):
            break
    return Episode(
        seed=seed,
        operator=index,
        level=person.level,
        success=solved > 0,
        actions=np.stack(actions),
        states=np.stack(states),
        rewards=np.array(rewards),
        observations={key: np.stack([entry[key] for entry in observations]) for key in observations[0]},
    )
