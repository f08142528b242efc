import threading
from dataclasses import replace

import pytest
import torch

pytest.importorskip("gymnasium")

import cloudpickle
import gymnasium
import numpy as np
from torchrl.envs import SerialEnv

from tests.errors import raises, refuses
from warmprior.envs.gymnasium import gym_env, registered_builder


class Dial(gymnasium.Env):
    """A dial that starts where its seed says; it counts its resets, and says in ``info`` what it knows."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, nested=False):
        self.nested, self.resets = nested, []
        dial = gymnasium.spaces.Box(-9.0, 9.0, (2,), np.float64)
        turns = gymnasium.spaces.Box(-9.0, 9.0, (1,), np.float64)
        both = gymnasium.spaces.Dict({"dial": dial, "turns": turns})
        self.observation_space = both if nested else dial

    def _seen(self):
        dial = np.array([self.at, -self.at])
        return {"dial": dial, "turns": np.array([float(self.turns)])} if self.nested else dial

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets.append(seed)
        self.at, self.turns = self.np_random.uniform(-1, 1), 0
        return self._seen(), {"solved": self.at > 0.5}

    def step(self, action):
        self.at, self.turns = self.at + float(action[0]), self.turns + 1
        info = {"solved": self.at > 0.5, "height": 2 * self.at}
        return self._seen(), 1.0, self.turns == 5, False, info if self.turns % 2 else {}


def actions(n=5):
    return torch.rand(n, 1, generator=torch.Generator().manual_seed(1)) * 2 - 1


def played(env, seed):
    """Observations, solved and height at the reset and after every step."""
    env.set_seed(seed)
    data = env.reset()
    found = [data]
    for action in actions():
        data = env.step(data.set("action", action))["next"]
        found.append(data)
    return [[d[key].squeeze().tolist() for d in found] for key in ("observation", "success", "height")]


@pytest.mark.parametrize("seed", [0, 7])
def test_episodes_are_those_of_the_bare_environment(seed):
    bare, env = Dial(), gym_env(Dial(), success="solved", measures=["height"])
    seen, info = bare.reset(seed=seed)
    expected = [(seen, info.get("solved", False), info.get("height", 0.0))]
    for action in actions():
        seen, _, _, _, info = bare.step(action.numpy())
        # What a step leaves out is 0: of no step is said what was said of another.
        expected.append((seen, info.get("solved", False), info.get("height", 0.0)))
    observations, solved, heights = played(env, seed)
    assert observations == [pytest.approx(seen) for seen, *_ in expected]
    assert solved == [bool(flag) for _, flag, _ in expected]
    assert heights == pytest.approx([height for *_, height in expected])
    # The flag of a reset is there as well; both kinds occur.
    assert any(solved) and not all(solved)


class Signs(Dial):
    """A dial that shows flags, a whole number and a choice."""

    def __init__(self):
        super().__init__()
        spaces = gymnasium.spaces
        parts = {"flags": spaces.MultiBinary(2), "grey": spaces.Box(0, 255, (1,), np.uint8)}
        self.observation_space = spaces.Dict(parts | {"choice": spaces.Discrete(3)})

    def _seen(self):
        return {"flags": np.array([1, 0], np.int8), "grey": np.array([200], np.uint8), "choice": 2}


def test_flags_and_whole_numbers_are_read_as_floats_and_a_choice_is_refused():
    env = gym_env(Signs(), observation_keys=["grey", "flags"])
    assert env.observation_spec["observation"].dtype == torch.float32
    assert SerialEnv(2, lambda: env).rollout(2)["observation"][1, 1].tolist() == [200.0, 1.0, 0.0]
    refuses(lambda: gym_env(Signs()), ValueError, "'choice'", "FlattenObservation")
    with raises(ValueError, "observation_keys", "['grey', 'grey']"):
        gym_env(Signs(), observation_keys=["grey", "grey"])
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    both = gymnasium.vector.SyncVectorEnv([lambda: Dial(nested=True)] * 2, autoreset_mode=mode)
    assert gym_env(both).reset()["observation"].shape == (2, 3)  # without what info tells
    refuses(lambda: gym_env(both, success="solved"), ValueError, "solved", "ParallelEnv")


@pytest.mark.parametrize("name", ["turns", "dial", "observation", "reward", "terminated"])
def test_info_replaces_nothing_else_that_a_step_returns(name):
    with raises(ValueError, f"['{name}'] of info"):
        gym_env(Dial(nested=True), success="solved", measures=["height", name])

    class Telling(Dial):
        def step(self, action):
            *returned, _ = super().step(action)
            return *returned, {name: np.zeros(1)}

    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    with raises(ValueError, f"['{name}'] of info"):
        gym_env(gymnasium.vector.SyncVectorEnv([lambda: Telling(nested=True)], autoreset_mode=mode))


def test_a_function_reads_info_too():
    env = gym_env(Dial())
    env.base_env.set_info_dict_reader(lambda info, data: data.set("entries", torch.tensor([len(info)])))
    assert env.step(env.rand_action(env.reset()))["next", "entries"].tolist() == [2]


@pytest.mark.parametrize("value", [0.5, -1, float("nan"), np.array([True, False])])
def test_a_fraction_is_no_success(value):
    class Saying(Dial):
        def step(self, action):
            return *super().step(action)[:4], {"solved": value}

    env = gym_env(Saying(), success="solved")
    refuses(lambda: env.rollout(5), ValueError, "'solved'", "measures")


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_observations_are_float32_and_stay_as_they_were_seen(dtype):
    class OneBuffer(Dial):
        def __init__(self):
            super().__init__()
            self.observation_space = gymnasium.spaces.Box(-9.0, 9.0, (2,), dtype)
            self.buffer = np.zeros(2, dtype)

        def _seen(self):
            self.buffer[:] = self.at, -self.at
            return self.buffer

    bare, env = Dial(), gym_env(OneBuffer())
    expected = [bare.reset(seed=3)[0], *(bare.step(action.numpy())[0] for action in actions())]
    env.set_seed(3)
    data = env.reset()
    kept = [data["observation"]]
    for action in actions():
        data = env.step(data.set("action", action))["next"]
        kept.append(data["observation"])
    assert {seen.dtype for seen in kept} == {torch.float32}
    np.testing.assert_allclose(torch.stack(kept), np.stack(expected), atol=0.01)


def test_every_seed_is_one_reset_and_later_episodes_are_others():
    base = Dial()
    env = gym_env(base, success="solved", measures=["height"])
    before = len(base.resets)
    first = played(env, 3)
    assert base.resets[before:] == [3]
    again = env.reset()["observation"]
    assert base.resets[before:] == [3, None] and again.tolist() != first[0][0]
    assert played(env, 3) == first  # whatever was played before


def registered_dial(monkeypatch):
    """Register a dial for a test; return the description of its environment, whose own reward is 1."""
    gymnasium.register("Dial-v0", Dial)
    monkeypatch.setitem(gymnasium.registry, "Dial-v0", gymnasium.registry.pop("Dial-v0"))
    return {"id": "Dial-v0", "max_episode_steps": 4, "success": "solved"}


def test_a_builder_takes_the_entry_with_it_if_it_can(monkeypatch):
    described = registered_dial(monkeypatch)
    sent = cloudpickle.dumps(registered_builder(described))
    entry, lock = gymnasium.registry["Dial-v0"], threading.Lock()
    # Another process has something else under this name.
    monkeypatch.setitem(gymnasium.registry, "Dial-v0", gymnasium.registry["Pendulum-v1"])
    assert isinstance(cloudpickle.loads(sent)().base_env._env.unwrapped, Dial)
    assert gymnasium.registry["Dial-v0"] is not entry

    def locked():
        with lock:  # which cannot be sent
            return Dial()

    monkeypatch.setitem(gymnasium.registry, "Dial-v0", replace(entry, entry_point=locked))
    sent = cloudpickle.dumps(registered_builder(described))
    assert isinstance(cloudpickle.loads(sent)().base_env._env.unwrapped, Dial)


@pytest.mark.parametrize("tells", ["always", "when solved", "never"])
def test_a_success_that_info_never_has_is_said_once(tells, recwarn):
    class Telling(Dial):
        def step(self, action):
            seen, *rest, _ = super().step(action)
            solved = self.at > 0.5
            present = tells == "always" or (solved and tells == "when solved")
            return seen, *rest, {"is_success": solved} if present else {}

    env = gym_env(Telling(), success="is_success")
    env.set_seed(1)
    solved = [env.rollout(5)["next", "success"].any() for _ in range(8)]
    assert any(solved) == (tells != "never")
    said = [str(w.message) for w in recwarn if "is_success" in str(w.message)]
    assert len(said) == (tells == "never" or (tells == "when solved" and not solved[0])) and all(
        "solved" in text for text in said
    )
    refuses(lambda: gym_env(Dial(), success="solved", measures=["success"]), ValueError, "measures")
