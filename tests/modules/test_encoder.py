import os

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.errors import raises, refuses
from tests.toy_env import random_history
from warmprior import (
    FlowMatchingLoss,
    ImageEncoder,
    PastPrior,
    PreconditionedNetwork,
    VelocityMLP,
    VisionNetwork,
    WarmPriorActor,
    window_replay_buffer,
)
from warmprior.modules.encoder import load_imagenet
from warmprior.saving.policies import load_policy, save_policy

CAMERAS = ("agentview_image", "robot0_eye_in_hand_image")
SIZE, CROP, STATE = 12, 8, 3


@pytest.mark.parametrize("size", [0, 7, 1025, 10**6, None, 12.0])
def test_sizes_of_images_that_no_decision_can_see(size):
    refuses(
        lambda: ImageEncoder(CAMERAS, STATE, image_size=size, backbone="small"),
        ValueError,
        "image_size",
        size,
    )


def test_the_smallest_images():
    assert [ImageEncoder(CAMERAS, STATE, image_size=n, backbone="small").crop_size for n in (8, 9)] == [8, 8]


def encoder_of(**options):
    given = {"image_size": SIZE, "crop_size": CROP, "backbone": "small"} | options
    if given["backbone"] == "resnet18":
        pytest.importorskip("torchvision")
    return ImageEncoder(CAMERAS, STATE, **given)


def observation_of(*batch, size=SIZE):
    draw, shape = torch.Generator().manual_seed(0), (*batch, 2, 3, size, size)
    images = {name: torch.randint(256, shape, dtype=torch.uint8, generator=draw) for name in CAMERAS}
    return TensorDict({"state": torch.randn(*batch, 2, STATE, generator=draw), **images}, batch)


def network_of(**options):
    encoder = encoder_of(**options)
    return VisionNetwork(encoder, VelocityMLP(2, encoder.observation_dim, 4, hidden_dim=16))


class Seen(nn.Module):
    """In place of a backbone: keeps what it is given."""

    def __init__(self):
        super().__init__()
        self.weight, self.windows = nn.Parameter(torch.ones(())), []

    def forward(self, pixels):
        self.windows.append(pixels)
        return self.weight * pixels.flatten(1).mean(1, keepdim=True)


def pixels_of(images):
    """What a backbone is given, written out channel by channel."""
    scaled = images.double() / 255
    for channel, (mean, deviation) in enumerate([(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)]):
        scaled[..., channel, :, :] = (scaled[..., channel, :, :] - mean) / deviation
    return scaled.float()


@pytest.mark.parametrize(("backbone", "features"), [("small", 64), ("resnet18", 512)])
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_vector_and_features_side_by_side(backbone, features, batch):
    encoder = encoder_of(backbone=backbone).eval()
    observation = observation_of(*batch)
    out = encoder(observation)
    assert out.shape == (*batch, 2, STATE + 2 * features)
    assert encoder.observation_dim == out.shape[-1]
    assert torch.equal(out[..., :STATE], observation["state"])
    for number, camera in enumerate(CAMERAS):  # each camera by its own network, one step at a time
        centre = observation[camera][..., 2 : 2 + CROP, 2 : 2 + CROP].flatten(0, -4)
        with torch.no_grad():
            alone = encoder.networks[number](pixels_of(centre))
        first = STATE + number * features
        part = out[..., first : first + features].flatten(0, -2)
        torch.testing.assert_close(part, alone, rtol=1e-4, atol=1e-4)


def test_one_network_for_all_cameras():
    shared, separate = encoder_of(share=True), encoder_of()
    assert len(shared.networks) == 1 and len(separate.networks) == 2
    assert shared.observation_dim == separate.observation_dim
    same = observation_of(3)
    same[CAMERAS[1]] = same[CAMERAS[0]]
    first, second = shared.eval()(same)[..., STATE:].chunk(2, -1)
    assert torch.equal(first, second)
    first, second = separate.eval()(same)[..., STATE:].chunk(2, -1)
    assert not torch.equal(first, second)


def test_random_windows_are_crops_of_all_steps_alike_and_reach_everywhere():
    encoder, seen = ImageEncoder(["cam"], 0, image_size=SIZE, crop_size=CROP, backbone="small"), Seen()
    encoder.networks[0] = seen
    images = torch.arange(2 * 3 * SIZE * SIZE).remainder(251).to(torch.uint8)
    images = images.view(2, 3, SIZE, SIZE).expand(400, 2, 3, SIZE, SIZE)
    torch.manual_seed(0)
    encoder(TensorDict({"cam": images}, [400]))
    (windows,) = seen.windows
    room = SIZE - CROP + 1
    places = [(top, left) for top in range(room) for left in range(room)]
    crops = torch.stack([pixels_of(images[0, :, :, y : y + CROP, x : x + CROP]) for y, x in places])
    found = set()
    for window in windows.detach().unflatten(0, (400, 2)):
        distance = (crops - window).abs().amax((1, 2, 3, 4))
        assert distance.min() < 1e-5
        found.add(int(distance.argmin()))
    assert len(found) == room * room  # of 25 in 400 draws: missed with probability 2e-6


def test_windows_follow_the_seed_and_evaluation_draws_none():
    encoder, observation = encoder_of(), observation_of(4)
    one, two, other = ((torch.manual_seed(seed), encoder(observation))[1] for seed in (3, 3, 4))
    assert torch.equal(one, two) and not torch.equal(one, other)
    state = torch.get_rng_state()
    centre = encoder.eval()(observation)
    assert torch.equal(torch.get_rng_state(), state)
    border = observation.clone()
    for camera in CAMERAS:
        border[camera][..., :2, :] = 0
        border[camera][..., -2:] = 0
    assert torch.equal(encoder(border), centre)


def test_observations_that_do_not_fit():
    encoder = encoder_of()
    refuses(lambda: encoder(observation_of(3).exclude(CAMERAS[1])), KeyError, "['robot0_eye_in_hand_image']")
    with raises(ValueError, "state", "[3, 2, 4]", "[3, 2, 3]"):
        encoder(observation_of(3).set("state", torch.zeros(3, 2, 4)))
    with raises(ValueError, "agentview_image", "[3, 2, 3, 9, 9]", "12, 12]"):
        encoder(observation_of(3, size=9))
    upright = observation_of(3)
    upright[CAMERAS[0]] = upright[CAMERAS[0]].movedim(-3, -1)
    refuses(lambda: encoder(upright), ValueError, "[3, 2, 12, 12, 3]")
    floats = observation_of(3)
    floats[CAMERAS[0]] = floats[CAMERAS[0]].float()
    refuses(lambda: encoder(floats), ValueError, "agentview_image", "float32", "uint8")
    narrow = VelocityMLP(2, 5, 4, hidden_dim=16)
    refuses(lambda: VisionNetwork(encoder, narrow), ValueError, 5, encoder.observation_dim)


def policy_of(network):
    return WarmPriorActor(network, PastPrior(4), generator=torch.Generator().manual_seed(0))


def decision_of(*batch):
    history = random_history(PastPrior(4), *batch, cold=0.0)
    return TensorDict({"observation": observation_of(*batch), "history": history}, batch)


def counted(network):
    calls = []
    network.encoder.register_forward_hook(lambda *call: calls.append(call))
    return calls


@pytest.mark.parametrize("precondition", [False, True])
@pytest.mark.parametrize("nfe", [1, 3, 9])
def test_the_encoder_runs_once_per_decision(precondition, nfe):
    network = network_of()
    calls = counted(network)
    policy = policy_of(PreconditionedNetwork(network) if precondition else network)
    policy(decision_of(3), nfe=nfe)
    assert len(calls) == 1


def demonstrations():
    observation = observation_of(40)
    first = TensorDict({key: value[:, 0] for key, value in observation.items()}, [40])
    episode = torch.arange(40) // 20
    return TensorDict({"observation": first, "action": torch.randn(40, 2), "episode": episode}, [40])


def test_the_encoder_runs_once_per_loss_and_learns():
    network = network_of()
    calls, policy = counted(network), policy_of(PreconditionedNetwork(network))
    loss = FlowMatchingLoss(policy)
    batch = window_replay_buffer(demonstrations(), policy.prior, batch_size=8).sample()
    assert batch["observation", CAMERAS[0]].shape == (8, 2, 3, SIZE, SIZE)
    loss(batch)["loss_flow_matching"].backward()
    assert len(calls) == 1
    assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in network.encoder.parameters())


@pytest.mark.parametrize("options", [{}, {"share": True}, {"backbone": "resnet18"}])
def test_a_saved_policy_returns_the_same_chunks(tmp_path, options):
    policy = policy_of(PreconditionedNetwork(network_of(**options))).eval()
    save_policy(policy, tmp_path)
    again = load_policy(tmp_path).replace(generator=torch.Generator().manual_seed(0))
    one, two = policy(decision_of(3)), again.eval()(decision_of(3))
    assert torch.equal(one["vla_action", "chunk"], two["vla_action", "chunk"])
    assert again.network.config() == policy.network.config()


def test_imagenets_weights_go_to_the_convolutions_of_every_camera(monkeypatch):
    models = pytest.importorskip("torchvision.models")
    torch.manual_seed(1)
    official = models.resnet18().state_dict()
    monkeypatch.setattr(models.ResNet18_Weights, "get_state_dict", lambda self, **options: official)
    encoder = encoder_of(backbone="resnet18")
    load_imagenet(encoder)
    for network in encoder.networks:
        for name, value in network.state_dict().items():
            if value.ndim == 4:
                assert torch.equal(value, official[name])
            else:  # group norm without effect
                assert value.unique().item() == (1.0 if name.endswith("weight") else 0.0)


class Planted:
    """Runs when it is unpickled."""

    def __reduce__(self):
        return (os.mkdir, (Planted.folder,))


@pytest.mark.parametrize("stored", [b"", b"<html>", b"PK\x03\x04" + bytes(99), Planted()])
def test_stored_weights_that_are_damaged_or_hold_code(tmp_path, monkeypatch, stored):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    path = tmp_path / "hub" / "checkpoints" / "resnet18-f37072fd.pth"
    path.parent.mkdir(parents=True)
    if isinstance(stored, bytes):
        path.write_bytes(stored)
    else:
        Planted.folder = str(tmp_path / "ran")
        torch.save({"conv1.weight": stored}, path)
    refuses(lambda: load_imagenet(encoder_of(backbone="resnet18")), OSError, "ResNet-18")
    assert not (tmp_path / "ran").exists()
