"""Images in environments, against states rendered by hand."""

import pytest
import torch

pytest.importorskip("robosuite")

from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.processes import apart
from warmprior import CameraImages, ChunkStep, ObservationStack
from warmprior.envs import RobosuiteEnv, rendering_backend

pytestmark = pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here")

CAMERAS = ("agentview", "robot0_eye_in_hand")
H = 4


def lift(**options):
    return RobosuiteEnv("lift", horizon=10, fast_rendering=True, sim_state=True, **options)


@apart
@pytest.mark.parametrize("steps", [1, 2])
def test_a_decision_sees_the_images_of_its_last_states(steps, monkeypatch):
    """As if every control step was rendered; but only those that it sees are."""
    single = lift()
    chunks = torch.rand(3, H, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1
    states, data = [], single.reset()
    states.append([data["sim_state"]] * steps)
    for chunk in chunks:
        for action in chunk:
            data = single.step(data.set("action", action))["next"]
            states.append([*states[-1], data["sim_state"]][-steps:])
            if data["done"]:
                break
    decisions = [states[i] for i in (0, 4, 8, 10)]  # the last ends with the episode

    frames, render = [], RobosuiteEnv.render_frame

    def counted(env, *args):
        frames.append(args)
        return render(env, *args)

    monkeypatch.setattr(RobosuiteEnv, "render_frame", counted)
    env = TransformedEnv(lift(), Compose(CameraImages(CAMERAS, 16), ObservationStack(steps)))
    env.append_transform(ChunkStep(H))
    check_env_specs(env)
    spec = env.observation_spec["observation", "agentview_image"]
    assert spec.shape == (steps, 3, 16, 16) and spec.dtype == torch.uint8
    env.set_seed(0)  # as the single one has it
    data, counts = env.reset(), []
    seen = [data["observation"]]
    for chunk in chunks:
        frames.clear()
        data = env.step(data.set(("vla_action", "chunk"), chunk))["next"]
        counts.append(len(frames) / len(CAMERAS))
        seen.append(data["observation"])
    assert data["done"] and max(counts) <= 1 + steps
    for observation, expected in zip(seen, decisions, strict=True):
        assert observation["state"].shape == (steps, 19)
        for camera in CAMERAS:
            by_hand = [render(single, camera, 16, state.numpy()) for state in expected]
            images = observation[f"{camera}_image"].permute(0, 2, 3, 1).numpy()
            assert (images == by_hand).all()
