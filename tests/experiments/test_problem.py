"""Problems in both spaces of actions."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("robosuite")

from tests.data.synthetic import env_args_15, write_robomimic_file
from warmprior import ODEActor, PoseTrend
from warmprior.data import DatasetError, generate_demonstrations
from warmprior.data.hdf5 import read_index
from warmprior.envs import rendering_backend
from warmprior.experiments import (
    Method,
    NetworkOptions,
    Recipe,
    RunOptions,
    Store,
    robosuite_problem,
)
from warmprior.experiments.recipe import DataOptions, HeldOutOptions
from warmprior.experiments.record import record, restore
from warmprior.io.files import file_digest
from warmprior.modules import Normalizer
from warmprior.training import TrainingConfig
from warmprior.transforms import AbsoluteActions


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 20), task="lift")
    return path


def store(problem, folder):
    network = NetworkOptions(hidden_dim=16)
    return Store(problem, network, folder / "policies", folder / "logs", RunOptions(logger="none"))


def test_recorded_actions_are_identified_by_their_file(path):
    """By their file alone."""
    problem = robosuite_problem(path)
    assert problem.identity == file_digest(path)
    assert "actions" not in problem.facts and problem.name == "lift ph (file data)"
    absolute = record(Recipe(data=DataOptions(actions="absolute")))
    assert absolute["data"]["actions"] == "absolute"
    assert restore(Recipe, absolute).data.actions == "absolute"
    assert restore(Recipe, record(Recipe())) == Recipe()
    assert restore(Recipe, absolute).name == "square-ph-absolute"


def test_absolute_actions(path, tmp_path):
    delta, absolute = (
        robosuite_problem(path, options=DataOptions(actions=name)) for name in ("delta", "absolute")
    )
    assert absolute.identity != delta.identity
    assert absolute.name == "lift ph (file data), absolute actions"
    assert absolute.data["action"].shape == (50, 10)
    assert isinstance(absolute.adapters["actions"], AbsoluteActions) and not delta.adapters
    # In the units of deltas, and what is executed spans what was recorded.
    units = [0.05] * 3 + [0.5] * 6
    assert absolute.normalizer.scale("action")[:9].tolist() == pytest.approx(units)
    assert absolute.data["action"][:, 9].abs().max() <= 1
    method = Method("gaussian", 8)
    stores = (store(p, tmp_path) for p in (delta, absolute))
    networks = [s.new_actor(method, TrainingConfig()).network for s in stores]
    assert networks[0].trend is None and isinstance(networks[1].trend, PoseTrend)


def test_what_leaves_the_span_of_the_demonstrations_is_remembered_at_its_bound(path, tmp_path):
    """Of every dimension: poses range over many control steps, the gripper over one unit."""
    delta, problem = (
        robosuite_problem(path, options=DataOptions(actions=name)) for name in ("delta", "absolute")
    )
    span = problem.data["action"].abs().amax(0)
    assert delta.clip == 1.0 and span[9] < span.max() / 2
    actor = store(problem, tmp_path).new_actor(Method("gaussian", 8), TrainingConfig())
    demonstrated, beyond = problem.data["action"][:8], 1e3 * problem.data["action"][8:16].sign()
    for wanted, expected in ((demonstrated, demonstrated), (beyond, beyond.clamp(-span, span))):
        mean = {("prior", "noise"): torch.zeros(1, 8, 10), "observation": torch.zeros(1, 2, 19)}
        ode = ODEActor(Towards(wanted), nfe=1, clip=actor.ode.clip)
        assert torch.equal(ode(TensorDict(mean, [1]))["vla_action", "chunk"][0], expected)


class Towards(torch.nn.Module):
    """The flow from 0 to a chunk."""

    def __init__(self, chunk):
        super().__init__()
        self.chunk = chunk

    def forward(self, t, a, observation):
        return self.chunk.expand_as(a)


def test_files_without_poses_are_named(tmp_path):
    import h5py

    path = tmp_path / "lift.hdf5"
    write_robomimic_file(path, lengths=(30,), task="lift", env_args=env_args_15("lift"))
    with h5py.File(path, "a") as file:
        del file["data/demo_0/obs/robot0_eef_quat"]
    with pytest.raises(DatasetError, match=r"lift\.hdf5.*no 'obs/robot0_eef_quat'"):
        robosuite_problem(path, options=DataOptions(actions="absolute"))


def test_part_of_a_file_is_its_first_demonstrations(path, tmp_path):
    whole, part = (
        robosuite_problem(path, options=DataOptions(demonstrations=n)) for n in ((), (1,))
    )
    assert part.identity == f"{whole.identity} the first 1"  # other policies, of the same file
    assert part.facts["demonstrations"] == 1 and part.facts["steps"] == len(part.data) == 30
    mine, all_of_it = (p.normalizer.denormalize(p.data)["action"] for p in (part, whole))
    assert torch.allclose(mine, all_of_it[:30], atol=1e-6)
    with pytest.raises(DatasetError, match="there are 2 demonstrations, fewer than the 3"):
        robosuite_problem(path, options=DataOptions(demonstrations=(3,)))


def test_another_task_is_refused_before_anything_is_rendered(path, monkeypatch):
    from warmprior.data import render
    from warmprior.experiments import problem, recipe

    monkeypatch.setattr(render, "render_demonstrations", lambda *_, **__: pytest.fail("rendered"))
    monkeypatch.setattr(recipe, "require_rendering", lambda: "egl")
    asked = DataOptions(task=("stack",), dataset=path, obs="image")
    with pytest.raises(ValueError, match="holds demonstrations of lift, not of stack"):
        problem.find_problems(asked)
    facts = {"task": "stack", "style": "ph", "source": "file", "demonstrations": 2, "sha256": ""}
    facts["images"] = {"cameras": ["agentview"], "size": 16, "fast_rendering": True}
    with pytest.raises(ValueError, match=r"of lift, but these .* are for stack"):
        problem.observe(
            HeldOutOptions(validation=path),
            facts,
            Normalizer({}, {}),
            chunk_length=4,
            observation_steps=2,
        )


@pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here")
def test_of_images_only_that_part_is_rendered(tmp_path, monkeypatch):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path / "cache"))
    path = generate_demonstrations("lift", n=2, workers=1, progress=False)
    problem = robosuite_problem(
        path,
        options=DataOptions(
            demonstrations=(1,),
            obs="image",
            cameras=("agentview",),
            image_size=16,
            fast_rendering=True,
        ),
    )
    assert problem.facts["demonstrations"] == 1 and problem.images == {"agentview_image": 16}
    (rendered,) = (tmp_path / "cache" / "rendered").glob("*.hdf5")
    index = read_index(rendered, image_keys=["agentview_image"])
    assert index.demos == ("demo_0",)
