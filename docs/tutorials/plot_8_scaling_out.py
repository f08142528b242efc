"""
8. Scaling out
==============

A comparison of sources is a grid: sources, seeds, checkpoints, numbers of steps. Its cells are
independent, so more cores and more machines finish it sooner, without changing a weight or a row.
This tutorial runs a small grid side by side, enlarges it, checks that promise, and shows
measurements of larger ones.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from warmprior.saving import load_policy

torch.manual_seed(0)

# %%
# A grid, side by side
# --------------------
# Every benchmark trains and evaluates in worker processes, as many as ``--workers`` says (one per core by
# default). A worker takes one job after another and computes with one thread. Here are the toy's
# policies from two sources, with a small network and two seeds. The script is found from the folder of this
# tutorial, ``docs/tutorials`` of a checkout: start it there.

folder = tempfile.TemporaryDirectory()
script = Path("../../benchmarks/navigation1d.py")
small = "--prior gaussian past --sigma 0.1 --network mlp,hidden_dim=64 --iterations 300 --nfe 3 --logger none"


def compare(run, seeds, workers):
    """The rows of a comparison on the toy, and what it printed."""
    out = Path(folder.name) / run
    more = f"--seeds {seeds} --workers {workers} --out {out}"
    options = f"{small} {more}".split()
    command = [sys.executable, str(script), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = (out / "results.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines], done.stdout


rows, _ = compare("grid/two_seeds", seeds=2, workers=2)
for row in rows:
    print(row["policy"], row["collision_rate"])

# %%
# Nothing is trained twice
# ------------------------
# A policy is in a folder named after everything that determines it, in ``policies/`` next to the
# runs. A run with a third seed finds the other four policies there, and trains two.

policies = Path(folder.name) / "grid" / "policies"
saved = {path: path.stat().st_mtime_ns for path in policies.glob("*/state*")}

more, _ = compare("grid/three_seeds", seeds=3, workers=2)
for path in sorted(policies.glob("*/state*")):
    kept = saved.get(path) == path.stat().st_mtime_ns
    print(path.parent.name, "as it was" if kept else "new")

# %%
# It is the same after an interruption: ``--resume`` continues a training run from its last saved
# state, and evaluates the missing rows.
#
# Nothing depends on who computes
# -------------------------------
# Here is one seed again, elsewhere, in a single worker. If the number of workers mattered, the
# weights would differ in the last bits, and so would the policies' actions.
# :func:`~warmprior.saving.load_policy` reads both.

alone, _ = compare("alone/run", seeds=1, workers=1)
print("the same rows:", alone == [row for row in more if row["seed"] == 0])
for row in alone:
    places = [policies, Path(folder.name) / "alone" / "policies"]
    one, other = (
        load_policy(place / row["policy"] / "policy_000300")
        for place in places
    )
    pairs = zip(one.parameters(), other.parameters(), strict=True)
    equal = all(torch.equal(first, second) for first, second in pairs)
    print(row["prior"], "has the same weights:", equal)

# %%
# What the cells are for: the spread between seeds is part of the result.

figure, axis = plt.subplots(figsize=(6, 2.4))
sources = {"gaussian": "#7f7f7f", "past": "#1f77b4"}
for place, (name, color) in enumerate(sources.items()):
    rates = [row["collision_rate"] for row in more if row["prior"] == name]
    axis.plot(rates, [place] * len(rates), "o", color=color, ms=8)
axis.set_yticks([0, 1], ["Gaussian source", "WP-Past"])
axis.set(xlabel="episodes that collide, NFE 3", xlim=(-0.03, 1.03))
axis.set(ylim=(-0.5, 1.5), title="Three training seeds of each source")
plt.show()
folder.cleanup()

# %%
# How far that goes
# -----------------
# With two cores WP-Past on square played 1.87 times as many episodes per minute as with one, and training
# runs side by side took 1.96 times as many steps (:doc:`/scaling`).
#
# More machines
# -------------
# The same grid goes to a `Ray <https://docs.ray.io>`_ cluster by one option, with the same rows. On
# one machine the local workers are the better choice: they start in a second instead of ten.
#
# .. code-block:: console
#
#    ray start --head --port=6379                    # on the first machine
#    ray start --address=HEAD:6379                   # on every other one
#    python benchmarks/robomimic.py --engine ray --ray-address HEAD:6379 --out /shared/runs/square
#
# ``--out`` is a folder that all machines see at the same path. If a machine is lost, Ray starts its
# jobs again elsewhere, and a training run continues from its last state. If the driver is lost, resume
# the run, with Ray or without:
#
# .. code-block:: console
#
#    python benchmarks/robomimic.py --resume --out /shared/runs/square
#
# One large network
# -----------------
# If a single training run takes too long, several processes share its batches. Each draws a part of
# every batch, so the weights depend on their number:
#
# .. code-block:: console
#
#    torchrun --nproc-per-node 2 benchmarks/robomimic.py --preset paper --device cuda
#    torchrun --nproc-per-node 8 benchmarks/robomimic.py --resume --out runs/square-ph-paper
#
# On CPUs it does not pay: two processes reached 0.64 of twice the speed of one with the paper's
# transformer, and less with small networks. None of this has been run on a GPU, or on more than one
# physical machine (:doc:`/scaling`).
