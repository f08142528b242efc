import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, MultiOneHot
from torchrl.envs import Compose, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises, refuses
from tests.toy_env import CountingEnv
from warmprior import (
    Normalizer,
    PastPrior,
    VelocityMLP,
    WarmPriorActor,
    normalizing_transforms,
    policy_transforms,
)
from warmprior.envs import NavigationEnv


def data(n=40):
    torch.manual_seed(0)
    scale = torch.tensor([1.0, 100.0, 0.01, 3.0])
    return TensorDict(
        {
            "observation": torch.randn(n, 4) * scale + 5 * scale,
            "action": torch.rand(n, 2) * torch.tensor([0.4, 2.0]) - 0.3,
            "episode": torch.arange(n) // 10,
        },
        [n],
    )


def test_constant_dimension():
    raw = data()
    raw["observation"][:, 1] = 7.5
    normalizer = Normalizer.fit(raw)
    out = normalizer.normalize(raw)
    assert (out["observation"][:, 1] == 0).all()
    assert (normalizer.denormalize(out)["observation"][:, 1] == 7.5).all()
    # Noise counts by the size of what it is on: of a body far from the origin it is larger.
    for middle, noise in ((0.0, 1e-6), (1000.0, 3e-4)):
        resting = raw.clone()
        resting["observation"][:, 1] = middle + noise * torch.linspace(-1, 1, 40)
        assert Normalizer.fit(resting).scale("observation")[1] == 1.0
    moved = raw.clone()
    moved["observation"][:, 1] += 0.25  # a value that the data never showed stays finite
    assert torch.allclose(normalizer.normalize(moved)["observation"][:, 1], torch.tensor(0.25))


def test_a_range_far_from_zero_is_scaled():
    low, high = torch.tensor([3e7 - 256]), torch.tensor([3e7 + 256])
    normalizer = Normalizer({"observation": low}, {"observation": high})
    units = normalizer.normalize(TensorDict({"observation": torch.stack([low, high])}, [2]))
    assert units["observation"].flatten().tolist() == [-1.0, 1.0]


class Whole(CountingEnv):
    """The toy with an observation of whole numbers, or of flags."""

    def __init__(self, dtype):
        super().__init__(5)
        self.observation_spec["observation"] = Bounded(0, 9, (2,), dtype=dtype)

    def _seen(self, out):
        seen = out["observation"][:2].to(self.observation_spec["observation"].dtype)
        return super()._seen(out).set("observation", seen)


@pytest.mark.parametrize("dtype", [torch.int64, torch.uint8, torch.bool])
def test_whole_numbers_and_flags_become_floats_in_a_batch_too(dtype):
    normalizer = Normalizer({"observation": torch.zeros(2)}, {"observation": torch.full((2,), 9.0)})

    def make():
        return TransformedEnv(Whole(dtype), Compose(*normalizing_transforms(normalizer)))

    raw = Whole(dtype).rollout(3)
    expected = normalizer.normalize(raw)["observation"]
    for env in (make(), SerialEnv(1, make)):
        assert env.observation_spec["observation"].dtype == torch.float32
        assert torch.equal(env.rollout(3)["observation"].reshape(-1, 2), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("assign", [False, True])
@pytest.mark.parametrize("batch", [None, SerialEnv])
def test_an_environment_follows_statistics_that_are_loaded_later(batch, assign, dtype):
    """Also where others take their place: by assignment, or in a policy that was cast."""

    def bounds(high):
        numbers = {"observation": torch.full((4,), high), "action": torch.full((2,), high**2)}
        return Normalizer({key: torch.zeros_like(value) for key, value in numbers.items()}, numbers)

    def make():
        return TransformedEnv(CountingEnv(5), Compose(*normalizing_transforms(first)))

    first, second = bounds(4.0), bounds(8.0)
    env = make() if batch is None else batch(1, make)
    env.reset()
    first.to(dtype)
    torch.manual_seed(0)
    raw = CountingEnv(5).rollout(3)
    for loaded in (bounds(4.0), second):
        first.load_state_dict(loaded.state_dict(), assign=assign)
        normal = iter(loaded.normalize(raw)["action"])
        play = TensorDictModule(lambda normal=normal: next(normal).expand(*env.batch_size, 2), [], ["action"])
        found = env.rollout(3, play)
        expected = loaded.normalize(raw["next"])["observation"]
        torch.testing.assert_close(found["next", "observation"].reshape(3, 4)[:, 2:], expected[:, 2:])


def test_what_others_hold_of_statistics_stays_as_it_is():
    def bounds(high):
        return Normalizer({"action": torch.full((2,), -high)}, {"action": torch.full((2,), high)})

    first, second, third = bounds(1.0), bounds(2.0), bounds(3.0)
    transforms = normalizing_transforms(first)
    env = TransformedEnv(CountingEnv(5), Compose(*transforms))
    env.reset()
    kept = first.state_dict()
    for loaded in (second, third):
        first.load_state_dict(loaded.state_dict(), assign=True)
        env.reset()
        torch.testing.assert_close(transforms[0].scale, loaded.scale("action"))
    for normalizer, high in ((second, 2.0), (third, 3.0)):
        assert (normalizer.scale("action") == bounds(high).scale("action")).all()
    first.load_state_dict(kept)
    assert (first.scale("action") == bounds(1.0).scale("action")).all()
    # A collector pickles a policy without its numbers, and its environments keep theirs.
    before = transforms[0].scale.clone()
    first.to("meta")
    env.reset()
    assert torch.equal(transforms[0].scale, before)


@pytest.mark.parametrize(
    ("spec", "kind"),
    [
        (Bounded(0, 9, (2,), dtype=torch.int64), "[2] of torch.int64"),
        (MultiOneHot([3, 4]), "MultiOneHot [7]"),
    ],
)
def test_whole_numbers_are_no_actions_of_a_policy(spec, kind):
    env = CountingEnv(5)
    env.action_spec = spec
    normalizer = Normalizer({"action": torch.zeros(2)}, {"action": torch.full((2,), 9.0)})
    with raises(TypeError, kind, "action", "rounds"):
        TransformedEnv(env, *normalizing_transforms(normalizer)).action_spec  # noqa: B018


def test_errors():
    raw = data()
    refuses(lambda: Normalizer.fit(raw[:0]), ValueError, "empty")
    refuses(lambda: Normalizer.fit(raw, ("state", "action")), KeyError, "['state']")
    broken = raw.clone()
    broken["action"][3, 1] = float("nan")
    refuses(lambda: Normalizer.fit(broken), ValueError, "action", "NaN", "3")
    fitted = Normalizer.fit(raw)
    narrow = TensorDict({"observation": torch.rand(5, 1), "action": torch.rand(5, 1)}, [5])
    for key, wide in (("observation", 4), ("action", 2)):
        for convert in (fitted.normalize, fitted.denormalize):  # one number would be broadcast
            with raises(ValueError, key, "[5, 1]", f"[{wide}]"):
                convert(narrow.select(key))
    for ends in (fitted.loc, fitted.scale):
        with raises(ValueError, "state", "observation"):
            ends("state")
    with raises(ValueError, "observation", "[9]", "[4]"):
        TransformedEnv(NavigationEnv(), normalizing_transforms(fitted)[0]).observation_spec  # noqa: B018
    for key in ("state", ("agent", "state")):  # an entry that the environment lacks would stay as it is
        other = Normalizer({key: torch.zeros(4)}, {key: torch.ones(4)})
        with raises(KeyError, str(key), "observation", "rename"):
            TransformedEnv(CountingEnv(5), *normalizing_transforms(other)).reset()
    one, two = {"a": torch.zeros(2)}, {"a": torch.zeros(3)}
    refuses(lambda: Normalizer(one, two), ValueError, "a", "[2]", "[3]")
    refuses(lambda: Normalizer(one, {"b": torch.zeros(2)}), ValueError, "['a']", "['b']")
    with raises(ValueError, "a", "above"):  # the dimension would count as constant
        Normalizer(one, {"a": torch.tensor([1.0, -1.0])})


@pytest.mark.parametrize(
    ("key", "values", "warned"),
    [
        ("action", 1e-6 * torch.linspace(-1, 1, 40), True),
        ("action", 1e-9 * torch.linspace(-1, 1, 40), False),
        ("action", 1000 + 1e-4 * torch.linspace(-1, 1, 40), False),  # rounding noise of float32
        ("observation", 48 + 1e-4 * torch.linspace(-1, 1, 40), True),  # degrees of latitude
        ("observation", 1e-6 * torch.linspace(-1, 1, 40), False),  # a body at rest
        ("observation", 1 + 1e-6 * torch.linspace(-1, 1, 40), False),
    ],
)
def test_a_warning_names_what_varies_and_counts_as_constant(key, values, warned):
    raw = data()
    raw[key][:, 1] = values
    expected = pytest.warns(UserWarning, match=rf"{key}.*\[1\].*constant")
    with expected if warned else warnings.catch_warnings(action="error"):
        Normalizer.fit(raw)


def test_numbers_without_a_dimension_are_fitted_without_a_warning():
    with warnings.catch_warnings(action="error"):
        Normalizer.fit(TensorDict({"observation": torch.randn(9), "action": torch.randn(9)}, [9]))


def test_the_whole_range_of_floats_and_any_key():
    most = torch.finfo(torch.float32).max
    raw = TensorDict({"observation.state": torch.tensor([[-most], [0.0], [most]])}, [3])
    normalizer = Normalizer.fit(raw, ("observation.state",))
    assert normalizer.normalize(raw)["observation.state"].flatten().tolist() == [-1.0, 0.0, 1.0]
    assert Normalizer.from_config(normalizer.config()).state_dict().keys() == normalizer.state_dict().keys()


def test_units_of_their_own():
    action = torch.tensor([[1.0, -2.0, 5.0], [1.2, 2.0, 5.0]])
    data = TensorDict({"action": action}, [2])
    normalizer = Normalizer.fit(data, ("action",), units={"action": torch.tensor([0.5, 0.0, 0.5])})
    expected = torch.tensor([[-0.2, -1.0, 0.0], [0.2, 1.0, 0.0]])
    torch.testing.assert_close(normalizer.normalize(data)["action"], expected)
    torch.testing.assert_close(normalizer.scale("action"), torch.tensor([0.5, 2.0, 0.5]))
    torch.testing.assert_close(normalizer.loc("action"), torch.tensor([1.1, 0.0, 5.0]))


def test_entries_of_an_observation_are_named_one_by_one():
    raw = data()
    raw["observation"] = TensorDict({"state": raw["observation"]}, [40])
    refuses(lambda: Normalizer.fit(raw), ValueError, "['state']", "keys=")
    nested = Normalizer.fit(raw, (("observation", "state"), "action"))
    assert nested.normalize(raw)["observation", "state"].amax() <= 1.0001


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_a_cast_policy_keeps_its_units(dtype):
    """The offset is large beside the range, so that half precision would lose it."""
    data = TensorDict({"observation": 100 + torch.rand(9, 3) / 50, "action": torch.rand(9, 1)}, [9])
    actor = WarmPriorActor(VelocityMLP(1, 3, 4), PastPrior(4), normalizer=Normalizer.fit(data))
    expected = actor.normalizer.normalize(data)
    actor.to(dtype)
    assert next(actor.network.parameters()).dtype == dtype
    torch.testing.assert_close(
        actor.normalizer.normalize(data)["observation"].float(), expected["observation"]
    )
    check_env_specs(TransformedEnv(GymEnv("Pendulum-v1"), policy_transforms(actor)))
    assert actor.normalizer.to("meta").loc("action").device.type == "meta"
