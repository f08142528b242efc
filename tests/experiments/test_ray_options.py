"""Options of the Ray engine: refused where they mean nothing, and no part of what a run is."""

from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip("tyro")

from warmprior.experiments import PRESETS, RunOptions, parse, record
from warmprior.experiments.prior_space import PRIOR_SPACE_PRESETS, GroupOptions


def test_options_without_the_engine_are_refused():
    with pytest.raises(ValueError, match="--ray-address belongs to --engine ray"):
        RunOptions(ray_address="head:6379")
    recipe = replace(PRIOR_SPACE_PRESETS["quick"], agents=GroupOptions(collectors=2))
    with pytest.raises(ValueError, match="--collectors belongs to --engine ray"):
        recipe.check()


def test_an_address_without_a_cluster_is_refused_before_anything_is_written(tmp_path):
    pytest.importorskip("ray")
    out = tmp_path / "out"
    argv = ["--engine", "ray", "--ray-address", "127.0.0.1:1", "--out", out]
    with pytest.raises(ConnectionError, match=r"127\.0\.0\.1:1 is no cluster"):
        parse(PRESETS, argv, study="robomimic")
    assert not out.exists()


@pytest.mark.parametrize("changeable", [False, True])
def test_the_engine_is_no_part_of_a_run(changeable):
    local = PRESETS["quick"]
    on_ray = replace(local, run=replace(local.run, engine="ray", ray_address="head:6379"))
    assert record(on_ray, changeable=changeable) == record(local, changeable=changeable)
