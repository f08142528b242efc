import json
import subprocess
import sys
import time

import peers
import pytest
import throughput
import torch
from tensordict import TensorDict

from lab.speed.timing import PRIOR, TO, Clock, H, steps
from lab.speed.windows import bare_ranges
from tests.benchmarks.script_parts import refused
from tests.errors import missing
from warmprior import GaussianPrior, window_replay_buffer, window_transforms


@pytest.mark.parametrize("name", peers.PEERS)
def test_peers_learn_from_the_same_windows(name):
    width, packages = peers.PEERS[name]
    for package in packages:
        pytest.importorskip(package)
    from lab.speed import peers as kinds

    torch.manual_seed(0)
    make = getattr(kinds, name)
    assert 0.9 < make(width, "cpu").parameters / 2e7 < 1.1
    peer = make(32 if "diffusion" in name else 96, "cpu")
    weights = [p for p in peer.module.parameters() if p.requires_grad]
    before = [p.detach().clone() for p in weights]
    batch = window_replay_buffer(steps(4, 50), GaussianPrior(H), batch_size=8).sample()
    kinds.training_step(peer, lambda: batch)()
    moved = [not torch.equal(a, b) for a, b in zip(weights, before, strict=True)]
    assert sum(moved) > 0.8 * len(moved)
    # Every evaluation passes through each layer of the network once.
    kinds = torch.nn.Conv1d if "diffusion" in name else torch.nn.Linear
    layers = [m for n, m in peer.module.named_modules() if isinstance(m, kinds) and "text" not in n]
    calls = []
    layers[-1].register_forward_hook(lambda *_: calls.append(None))
    with torch.no_grad():
        peer.module.eval()
        peer.decide(3)
    assert len(calls) == 3


def throughputs(folder, *argv):
    throughput.main([*argv, "--repeats", "1", "--out", str(folder)])
    return json.loads((folder / "throughput.json").read_text())


def test_throughput_reports_a_folder_that_is_a_file(tmp_path, capsys):
    (tmp_path / "taken").touch()
    argv = ["--only", "windows_over_torch", "--out", tmp_path / "taken"]
    assert not missing(refused(throughput.main, argv, capsys), "throughput.py", "taken")


def test_throughput_writes_every_key(tmp_path):
    results = throughputs(tmp_path, "--only", "windows_over_torch", "preconditioning_over_network")
    found = {key for key, value in results.items() if value is not None}
    assert found == {"windows_over_torch", "preconditioning_over_network", "meta"}
    assert results.keys() == {"meta"}.union(*throughput.FIGURES.values())
    assert min(results["windows_over_torch"].values()) > 0 and results["preconditioning_over_network"] > 0


def test_bare_ranges_are_all_that_a_window_holds():
    data = steps(5, 20)
    window = window_transforms(data, PRIOR, observation_steps=TO)
    torch.manual_seed(0)
    bare = bare_ranges(data, 64)()
    torch.manual_seed(0)
    frame = torch.randint(len(data), (64,))
    batch = window(TensorDict({"frame": frame}, [64]))
    names = ("actions", "steps", "forecast", "forecast_steps")
    names = ["observation", ("vla_action", "chunk"), "action_is_pad", *(("history", name) for name in names)]
    for name, value in zip(names, bare, strict=True):
        assert torch.equal(batch[name], value), name


def test_rounds_are_interleaved_and_the_first_is_dropped():
    class Bar:
        def set_postfix(self, **kwargs): ...

    order = []
    calls = (lambda: order.append("a"), lambda: order.append("b"))
    times = Clock(3, Bar()).times(*calls, before=lambda: order.append("|"))
    assert "".join(order) == "|ba|ab|ba|ab" and [len(rounds) for rounds in times] == [3, 3]
    ratio = Clock(5, Bar()).ratio(lambda: time.sleep(0.03), lambda: time.sleep(0.01))
    assert ratio == pytest.approx(3, rel=0.4)


@pytest.mark.slow
def test_every_throughput_can_be_measured(tmp_path):
    script, out = throughput.__file__, ["--repeats", "1", "--out", str(tmp_path)]
    subprocess.run([sys.executable, script, *out], check=True)  # it renders, which no fork survives
    results = json.loads((tmp_path / "throughput.json").read_text())
    missing = {name for name, value in results.items() if value is None}
    on_gpus = {"cuda_train_step_over_network", "cuda_steps_per_second"}
    assert missing <= {"lerobot_windows_over_getitem", *on_gpus}
