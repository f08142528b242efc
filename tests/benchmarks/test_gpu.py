"""The script for a GPU in its smallest form: a row per part, parts that are done, and parts that fail."""

import subprocess
import sys
from itertools import count
from types import SimpleNamespace

import gpu
import pytest

from tests.benchmarks.script_parts import refused, stored
from warmprior.envs import rendering_backend


@pytest.fixture
def demonstrations(lift_demonstrations, monkeypatch):
    monkeypatch.setenv("WARMPRIOR_CACHE", str(lift_demonstrations.parents[1]))


def smallest(out, *parts, **options):
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    return ["--device", "cpu", "--smallest", "--out", out, "--commit", "abc", "--part", *parts, *words]


def run(*args, **options):
    return gpu.main([str(word) for word in smallest(*args, **options)])


def test_parts_write_rows_once_and_a_failure_stops_no_other(demonstrations, tmp_path, monkeypatch, capsys):
    def broken(options, seconds):
        raise ValueError(f"it broke after {seconds:g} s")

    with monkeypatch.context() as patch:
        patch.setitem(gpu.PARTS, 2, (broken, 3.0))
        said = refused(gpu.main, smallest(tmp_path, 2, 3, 4), capsys)
    assert said.endswith("part 2, broken: it broke after 180 s")
    speed, states = stored(tmp_path, "parts")
    assert (speed["part"], states["part"]) == (3, 4) and min(speed["results"].values()) > 0
    (trained,), played = states["results"]["trained"], states["results"]["played"]
    assert trained["iterations"] == gpu.TINY_PROBE and trained["prior"] == "past"
    assert trained["iterations_per_second"] > 0 and trained["loss"] != trained["first_loss"]
    assert [(row["nfe"], row["episodes"]) for row in played] == [(9, 1), (3, 1), (1, 1)]

    assert run(tmp_path, 2, 3, 4) == 0
    assert "part 4, states: done before" in capsys.readouterr().out
    assert [row["part"] for row in stored(tmp_path, "parts")] == [3, 4, 2]
    assert stored(tmp_path, "parts")[-1]["results"] == {"cuda_train_step_over_network": None}
    assert run(tmp_path, 3, preset="quick") == 0  # other options are another row
    assert [row["options"]["preset"] for row in stored(tmp_path, "parts")] == ["paper"] * 3 + ["quick"]


def test_methods_share_the_time(demonstrations, tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "iterations_per_second", lambda policy: 0.2)
    ticks = SimpleNamespace(monotonic=count(0, 2).__next__)  # two seconds pass from one look to the next
    monkeypatch.setattr(gpu, "time", ticks)
    options = gpu.GpuOptions(prior=("past", "gaussian"), device="cpu", smallest=True, minutes=1, out=tmp_path)
    _, policies = gpu.train_for(options, 60, "state")
    assert [policy.method.name for policy in policies] == ["past", "gaussian"]
    (iterations,) = {policy.training.iterations for policy in policies}
    # Half of the minute each; what the first training took beyond its iterations is taken off.
    beyond = 2 - gpu.TINY_PROBE / 0.2
    assert iterations == int(0.2 * ((60 - 6) / 2 - beyond))
    assert all(policy.is_trained for policy in policies)


@pytest.mark.slow
@pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here")
def test_every_part_can_be_tried_without_a_gpu(demonstrations, tmp_path):
    words = ["--device", "cpu", "--smallest", "--commit", "abc", "--out", str(tmp_path)]
    subprocess.run([sys.executable, gpu.__file__, *words], check=True)
    found = {row["part"]: row["results"] for row in stored(tmp_path, "parts")}
    assert list(found) == list(gpu.PARTS)
    assert found[1]["passed"] + found[1]["skipped"] >= 12 and not found[1]["failed"]
    assert found[0]["image"]["demonstrations"] == 3 and found[5]["trained"][0]["iterations"] == gpu.TINY_PROBE
