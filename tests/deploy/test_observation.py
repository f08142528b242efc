"""Observations of drivers reach the policy in the form of its training, or are refused by name."""

import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.deploy.test_executor import OBSERVATION_DIM, Scripted, actor
from tests.errors import missing, raises, refuses
from tests.toy_env import ACTION_DIM, stirred
from warmprior import (
    HistoryObservation,
    ImageEncoder,
    Normalizer,
    PastPrior,
    VelocityMLP,
    VisionNetwork,
    WarmPriorActor,
    keys,
)
from warmprior.deploy import AsyncExecutor
from warmprior.deploy.observation import observation_shapes
from warmprior.modules.recording import Recording

CAMERAS = ("front_image", "wrist_image")


def sighted(**options):
    """A policy of two cameras of 16 x 16 pixels, whose central 12 x 12 it sees, and a state of 3."""
    torch.manual_seed(0)
    encoder = ImageEncoder(CAMERAS, 3, image_size=16, crop_size=12, backbone="small")
    velocity = stirred(VelocityMLP(ACTION_DIM, encoder.observation_dim, 6, hidden_dim=16))
    ones = {("observation", "state"): torch.ones(3), "action": torch.ones(ACTION_DIM)}
    normalizer = Normalizer(*({key: bound * one for key, one in ones.items()} for bound in (-3.0, 5.0)))
    generator = torch.Generator().manual_seed(5)
    network = VisionNetwork(encoder, velocity)
    return WarmPriorActor(network, PastPrior(6), nfe=2, normalizer=normalizer, generator=generator, **options)


def seen_by(policy):
    found = []
    policy.register_forward_pre_hook(lambda module, args: found.append(args[0]["observation"].clone()))
    return found


def pictures(height, width):
    return {name: np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8) for name in CAMERAS}


def test_images_are_those_of_the_training():
    """Channels first and of the training's size, whatever a camera gives; the state in the policy's units."""
    image = pytest.importorskip("PIL.Image")
    policy = sighted()
    found = seen_by(policy)
    with AsyncExecutor(policy, latency=0, execute=1) as executor:
        assert executor._frames.maxlen == 2
        images = pictures(16, 16)
        first = executor.act({"state": np.array([5.0, 1.0, -3.0]), **images, "speed": 3.0})
        large = pictures(50, 70)
        executor.act({"state": torch.tensor([5.0, 1.0, -3.0]), **large})
    seen = found[0]
    assert set(seen.keys()) == {"state", *CAMERAS}
    assert seen["state"].tolist() == [[1.0, 0.0, -1.0]] * 2
    for name in CAMERAS:
        assert torch.equal(seen[name], torch.from_numpy(images[name]).permute(2, 0, 1).expand(2, 3, 16, 16))
        small = np.array(image.fromarray(large[name]).resize((16, 16), image.Resampling.BILINEAR), np.int64)
        resized = found[1][name][1].permute(1, 2, 0).long()
        assert np.abs(resized.numpy() - small).max() <= 1
    # What the encoder then sees is the middle: its own crop, in evaluation mode.
    outside = {name: image.copy() for name, image in images.items()}
    for picture in outside.values():
        picture[:2] = picture[-2:] = picture[:, :2] = picture[:, -2:] = 0
    with AsyncExecutor(sighted(), latency=0) as executor:
        assert torch.equal(executor.act({"state": torch.tensor([5.0, 1.0, -3.0]), **outside}), first)
    assert first.min() >= -3 and first.max() <= 5


def test_images_in_every_form_are_equal():
    images, state = pictures(24, 40), [0.0, 1.0, 2.0]
    turned = {name: image[..., ::-1].copy()[..., ::-1] for name, image in images.items()}  # BGR to RGB
    first = {name: torch.from_numpy(image).permute(2, 0, 1) for name, image in images.items()}
    nested = TensorDict({"state": torch.tensor(state), **first})
    actions = []
    for observation in ({"state": state, **images}, {"state": state, **turned}, nested):
        with AsyncExecutor(sighted(), latency=0) as executor:
            actions.append(executor.act(observation))
    assert torch.equal(actions[0], actions[1]) and torch.equal(actions[0], actions[2])


@pytest.mark.parametrize(
    ("change", "kind", "said"),
    [
        ({"wrist_image": None}, KeyError, ["wrist_image"]),
        ({"state": np.zeros(4)}, ValueError, ["state", "[4]", "[3]"]),
        ({"state": np.zeros(3, ">f4")}, ValueError, ["state", "byte order"]),  # as in recorded messages
        ({"front_image": np.zeros((16, 16, 3))}, ValueError, ["front_image", "float64", "uint8"]),
        ({"front_image": np.zeros((16, 16), np.uint8)}, ValueError, ["front_image", "[16, 16]"]),
        ({"front_image": np.zeros((16, 16, 4), np.uint8)}, ValueError, ["front_image", "[16, 16, 4]"]),
        ({"front_image": np.zeros((0, 16, 3), np.uint8)}, ValueError, ["front_image", "[0, 16, 3]"]),
        ({"front_image": "no signal"}, ValueError, ["front_image", "numpy.str_"]),
    ],
)
def test_what_is_no_observation_is_refused_and_changes_nothing(change, kind, said):
    usual = {"state": np.zeros(3), **pictures(20, 20)}
    with AsyncExecutor(sighted(), latency=0) as executor, AsyncExecutor(sighted(), latency=0) as other:
        for _ in range(8):
            with raises(kind, *said) as refused:
                executor.act(usual | change)
            assert "\n" not in str(refused.value)
            assert torch.equal(executor.act(usual), other.act(usual))
        refuses(lambda: executor.act(np.zeros(3)), ValueError, "front_image")


def test_a_vector_may_be_the_state_among_others():
    one, two = (AsyncExecutor(actor(PastPrior(6)), latency=0) for _ in range(2))
    seen = np.linspace(-1, 1, OBSERVATION_DIM)
    for _ in range(8):
        action = one.act({"state": seen, "front_image": pictures(8, 8)})
        assert torch.equal(action, two.act(torch.tensor(seen)))
    with raises(ValueError, "[1]", [OBSERVATION_DIM]):  # it would be broadcast
        one.act(torch.zeros(1))
    refuses(lambda: one.act({"front_image": pictures(8, 8)}), KeyError, "state", "front_image")


def test_a_normaliser_without_the_observation_and_whole_numbers():
    policy = sighted()
    for lacking in ({"action": torch.ones(2)}, {"action": torch.ones(2), "observation": torch.ones(3)}):
        normalizer = Normalizer(lacking, {key: 2 * value for key, value in lacking.items()})
        with raises(ValueError, "'state'"):
            AsyncExecutor(policy, latency=0, normalizer=normalizer)
    found = seen_by(policy := sighted().replace(normalizer=None))
    with AsyncExecutor(policy, latency=0) as executor:
        executor.act({"state": np.array([1, 0, 1]), **pictures(16, 16)})
    assert found[0]["state"].tolist() == [[1.0, 0.0, 1.0]] * 2


@pytest.mark.parametrize("width", [3, 0])
def test_a_policy_of_images_that_sees_the_history_asks_for_what_a_driver_gives(width):
    """A state of width 0 is that of a policy of images alone."""
    prior = PastPrior(6)
    added = HistoryObservation.width(prior.history_length, ACTION_DIM)
    encoder = ImageEncoder(CAMERAS, width + added, image_size=16, crop_size=12, backbone="small")
    network = VisionNetwork(encoder, VelocityMLP(ACTION_DIM, encoder.observation_dim, 6, hidden_dim=16))
    policy = WarmPriorActor(network, prior, observation_key=keys.CONDITIONED)
    assert observation_shapes(policy) == {"state": (width,), **dict.fromkeys(CAMERAS, (3, 16, 16))}
    observation = pictures(16, 16) | ({"state": np.zeros(width)} if width else {})
    with AsyncExecutor(policy, latency=1) as executor:
        assert executor.act(observation).shape == (ACTION_DIM,)


def test_an_entry_that_is_none_is_not_said_to_be_there():
    with AsyncExecutor(sighted(), latency=0) as executor, raises(KeyError, "there are ['front_image']"):
        executor.act({"state": None, "front_image": pictures(16, 16)["front_image"]})
    with AsyncExecutor(actor(PastPrior(6)), latency=0) as executor, raises(KeyError, "state", "there are []"):
        executor.act(None)


def test_drivers_reuse_their_memory():
    policy, memory = Scripted(8), np.zeros(1)
    policy.prior, policy.action_dim = PastPrior(8), 2
    with AsyncExecutor(policy, latency=0, execute=1) as executor:
        for tick in range(3):
            memory[:] = tick
            executor.act(memory)
    assert policy.given[-1]["observation"].flatten().tolist() == [1.0, 2.0]


JOINTS = ("pan", "lift", "grip")


def described(shape=(480, 640), normalizer=True, low=(-100.0, 20.0, 7.0), high=(100.0, 60.0, 7.0)):
    """A policy of a camera, and of three joints whose last never moved, that knows the dataset's names."""
    torch.manual_seed(0)
    encoder = ImageEncoder(["front_image"], 3, image_size=16, crop_size=12, backbone="small")
    network = VisionNetwork(encoder, VelocityMLP(ACTION_DIM, encoder.observation_dim, 6, hidden_dim=16))
    key, ones = ("observation", "state"), torch.ones(ACTION_DIM)
    ends = ({key: torch.tensor(end), "action": ones} for end in (low, high))
    recording = Recording(
        *("arm", 2, 60, "[2], as recorded", {"observation.state": 2, "effort": 1}),
        names={"front_image": "observation.images.front"},
        numbers={"observation.state": JOINTS[:2]},
        sizes={"front_image": shape},
    )
    normalizer = Normalizer(*ends) if normalizer else None
    return WarmPriorActor(network, PastPrior(6), normalizer=normalizer, recording=recording)


def seen_at(state, height=480, width=640):
    return {"state": np.array(state), "front_image": np.zeros((height, width, 3), np.uint8)}


@pytest.mark.parametrize("normalizer", [True, False])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_none_is_named_as_the_dataset_does(value, normalizer):
    usual = seen_at([0.0, 40.0, 7.0])
    with AsyncExecutor(described(normalizer=normalizer), latency=0) as executor:
        with raises(ValueError, "observation.state lift", "effort [0]") as refused:
            executor.act(seen_at([0.0, value, value]))
        assert missing(str(refused.value), "pan") == ["pan"]
        parts = {"observation.state": [value, 40.0], "effort": [7.0], "front_image": usual["front_image"]}
        refuses(lambda: executor.act(parts), ValueError, "observation.state pan")
        assert executor.act(usual).isfinite().all()
    with AsyncExecutor(actor(PastPrior(6)), latency=0) as executor, raises(ValueError, "state [1]"):
        executor.act(torch.tensor([0.0, value, *[0.0] * (OBSERVATION_DIM - 2)]))


def said_of(executor, *observations):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for observation in observations:
            executor.act(observation)
    assert all(warning.filename == __file__ for warning in caught)
    return [str(warning.message) for warning in caught]


def test_the_vector_that_lacks_is_named():
    whole = {
        "observation.state": np.zeros(2),
        "effort": np.zeros(1),
        "front_image": seen_at([0])["front_image"],
    }
    with AsyncExecutor(described(), latency=0) as executor:
        for name in ("observation.state", "effort"):
            with raises(KeyError, f"missing: ['{name}']"):
                executor.act({key: value for key, value in whole.items() if key != name})
        executor.act(whole)


def test_one_is_warned_once_of_numbers_far_from_the_demonstrations():
    """Half their range beyond an end: lift from 0 to 80, whose demonstrations are from 20 to 60."""
    with AsyncExecutor(described(), latency=0) as executor:
        near = [seen_at(state) for state in ([-199.0, 1.0, 7.0], [199.0, 79.0, 7.0], [0.0, 40.0, 8.5])]
        assert not said_of(executor, *near)
        (said,) = said_of(executor, seen_at([210.0, 4000.0, 7.0]), seen_at([0.0, -4000.0, 7.0]))
        assert not missing(said, "observation.state lift", 4000, 20, 60)
        executor.reset()
        assert not said_of(executor, seen_at([0.0, 4000.0, 7.0]))
        (said,) = said_of(executor, seen_at([0.0, 40.0, 999.0]))
        assert not missing(said, "effort [0]", 999, 7)
    with AsyncExecutor(described(high=(100.0, 60.0, 11.0)), latency=0) as executor:
        first, second = said_of(executor, seen_at([-300.0, 40.0, 17.0]))
        assert not missing(first, "effort [0]", 17, 7, 11) and not missing(second, "pan", -300, -100, 100)
    with AsyncExecutor(described(normalizer=False), latency=0) as executor:
        assert not said_of(executor, seen_at([0.0, 4000.0, 7.0]))


@pytest.mark.parametrize(
    ("recorded", "size", "warned"),
    [
        ((480, 640), (240, 320), False),
        ((480, 640), (479, 640), False),
        ((480, 640), (480, 655), True),
        ((480, 640), (720, 1280), True),
        ((480, 640), (640, 480), True),
        ((16, 16), (480, 640), False),  # whoever recorded them may have resized them
        ((480, 640), (16, 16), False),  # a driver that resizes
    ],
)
def test_one_is_warned_once_of_pictures_of_another_ratio(recorded, size, warned):
    with AsyncExecutor(described(recorded), latency=0) as executor:
        said = said_of(executor, *[seen_at([0.0, 40.0, 7.0], *size)] * 3)
    assert len(said) == warned
    facts = "observation.images.front", "{} x {}".format(*size), "{} x {}".format(*recorded)
    assert not missing(" ".join(said), *facts if warned else ())
