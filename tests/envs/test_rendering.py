"""Images of the simulator against robosuite's own renderer, and what rendering must leave alone."""

from functools import partial

import numpy as np
import pytest
import torch

pytest.importorskip("robosuite")


from tests.errors import raises
from tests.processes import apart
from warmprior.envs import RobosuiteEnv, rendering_backend
from warmprior.envs.rendering import CameraRenderer, require_rendering
from warmprior.envs.simulator import import_robosuite, task_env_args

pytestmark = pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here")

CAMERAS = ("agentview", "robot0_eye_in_hand")
SIZE = 32


@pytest.fixture(scope="module")
def lift():
    env = RobosuiteEnv("lift", horizon=20, sim_state=True, fast_rendering=True)
    env.reset()
    return env


@apart
def test_pixels_are_those_of_robosuites_own_renderer(lift, monkeypatch):
    """At its default quality; it returns them upside down."""
    monkeypatch.setenv("MUJOCO_GL", require_rendering())
    options = {"has_offscreen_renderer": True, "render_gpu_device_id": -1}
    theirs = import_robosuite().make("Lift", **task_env_args("lift")["env_kwargs"] | options)
    theirs.reset()
    renderer = CameraRenderer(theirs.sim.model._model, SIZE, SIZE)
    for camera in CAMERAS:
        shown = theirs.sim.render(SIZE, SIZE, camera_name=camera)[::-1]
        assert shown.std() > 10, "an empty image would agree with another"
        np.testing.assert_array_equal(renderer.render(camera, theirs.sim.data.qpos), shown)


@apart
def test_episodes_go_on_as_if_nothing_was_rendered():
    actions = torch.rand(3, 7, generator=torch.manual_seed(0)) * 2 - 1

    def states(*cameras):
        env = RobosuiteEnv("lift", sim_state=True, fast_rendering=True)
        data, found = env.reset(), []
        for action in actions:
            data = env.step(data.set("action", action))["next"]
            found.append(data["sim_state"])
            for camera in cameras:
                env.render_frame(camera, 16)
                env.render_frame("frontview", 16, found[0].numpy())
        return torch.stack(found)

    assert torch.equal(states(*CAMERAS), states())


@apart
def test_a_state_is_rendered_as_it_was_when_present(lift):
    """Also after the episode, and another, have gone on."""
    data = lift.reset()
    state = data["sim_state"].numpy()
    present = lift.render_frame()
    lift.rollout(5)
    assert not np.array_equal(lift.render_frame(), present)
    np.testing.assert_array_equal(lift.render_frame(state=state), present)
    assert lift.render_frame(size=(8, 24)).shape == (8, 24, 3)


@apart
def test_a_process_forked_from_one_that_has_rendered_says_so(lift):
    """Instead of waiting for OpenGL's threads, which are not there, for ever."""
    lift.render_frame(size=SIZE)
    for size in (SIZE, 16):  # with the renderer that is there, and with a new one
        with raises(RuntimeError, "fork"):
            apart(partial(lift.render_frame, size=size))()
    # What is forked but does not render is none of its business.
    assert apart(partial(sum, [1, 2]))() == 3
