"""The throughput script: its keys, its options, and the clock that its ratios rest on."""

from __future__ import annotations

import importlib.util
import json
import time
from pathlib import Path

import pytest
import torch

pytest.importorskip("robosuite")

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "dev" / "throughput.py"
KEYS = {
    "windows_per_second",
    "windows_over_torch",
    "lerobot_windows_over_getitem",
    "train_step_over_network",
    "ddp_efficiency",
    "cuda_train_step_over_network",
    "cuda_latency",
    "preconditioning_over_network",
    "modulation_over_input",
    "actor_over_network",
    "actor_over_network_compiled",
    "env_over_robosuite",
    "chunk_step_overhead",
    "load_memory_over_data",
    "image_windows_over_h5py",
    "encoder_share",
    "prior_space_decoding",
    "prior_space_collection_over_env",
    "job_overhead",
    "meta",
}


@pytest.fixture(scope="module")
def throughput():
    spec = importlib.util.spec_from_file_location("benchmark_throughput", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Bar:
    def set_postfix(self, **kwargs): ...


def test_writes_every_key(throughput, tmp_path):
    throughput.main(["--only", "windows_per_second", "--repeats", "1", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "throughput.json").read_text())
    assert results.keys() == KEYS
    assert results["windows_per_second"] > 0
    assert results["env_over_robosuite"] is None
    assert {"python", "torch", "warmprior"} <= results["meta"]["versions"].keys()
    assert {"cpu", "torch_threads", "date"} <= results["meta"]["hardware"].keys()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_what_needs_a_gpu_is_skipped_by_name(throughput, tmp_path, capsys):
    names = ["cuda_train_step_over_network", "cuda_latency"]
    throughput.main(["--only", *names, "--repeats", "1", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "throughput.json").read_text())
    said = capsys.readouterr()
    for name in names:
        assert results[name] is None and f"{name}: skipped, needs a GPU" in said.out + said.err


def test_ratio_of_known_times(throughput):
    clock = throughput.Clock(5, Bar())
    ratio = clock.ratio(lambda: time.sleep(0.03), lambda: time.sleep(0.01))
    assert ratio == pytest.approx(3, rel=0.4)


@pytest.mark.slow
def test_every_figure_can_be_measured(throughput, tmp_path):
    throughput.main(["--repeats", "1", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "throughput.json").read_text())
    missing = {name for name, value in results.items() if value is None}
    on_gpus = {"cuda_train_step_over_network", "cuda_latency"}
    assert missing <= {"lerobot_windows_over_getitem", *on_gpus}
    assert results["actor_over_network"].keys() == {"1", "3", "9"}
