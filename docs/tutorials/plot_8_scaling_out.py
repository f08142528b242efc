"""
8. Scaling out
==============

A comparison of sources is a grid: sources, seeds, checkpoints, numbers of steps. Its cells need
nothing of each other, so that more cores and more machines finish it sooner, and nothing else may
change: not a weight, and not a row. This tutorial runs a small grid side by side, enlarges it,
checks that promise, and shows what was measured on larger ones.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from warmprior.experiments import (
    NAVIGATION_PRESETS,
    Comparison,
    Method,
    RunOptions,
    Store,
    judge_navigation,
    navigation_problem,
)

torch.manual_seed(0)

# %%
# A grid, side by side
# --------------------
# :class:`~warmprior.experiments.Comparison` of :doc:`tutorial 2 <plot_2_own_prior>` trains in worker
# processes, as many as :class:`~warmprior.experiments.RunOptions` says by ``envs`` (one per core by
# default). A worker takes one cell after another and computes with one thread. On the command line
# that is ``--envs 2 --seeds 2``.

folder = tempfile.TemporaryDirectory()


def compare(run, seeds, envs):
    """The toy, two sources, with a small recipe."""
    recipe = NAVIGATION_PRESETS["quick"]
    recipe = replace(
        recipe,
        network=replace(recipe.network, hidden_dim=64),
        training=replace(
            recipe.training,
            iterations=300,
            learning_rate=4e-3,
            save_every=300,
            cold_probability=0.1,
        ),
        evaluation=replace(recipe.evaluation, seeds=seeds),
        run=RunOptions(out=Path(folder.name) / run, envs=envs, logger="none"),
    )
    methods = [
        Method.parse(name, 4, sigma=0.1) for name in ("gaussian", "past")
    ]
    return Comparison(
        recipe,
        "grid",
        stores=[Store.of(recipe, navigation_problem())],
        methods=methods,
    )


first = compare("grid/two_seeds", seeds=2, envs=2)
first.train()

# %%
# Nothing is trained twice
# ------------------------
# A policy lies in a folder that is named by all that determines it, in ``policies/`` beside the
# runs. A run with a third seed finds the other four policies there, and trains two.

policies = Path(folder.name) / "grid" / "policies"
found = {path.name for path in policies.iterdir()}
saved = {name: (policies / name).stat().st_mtime_ns for name in found}

more = compare("grid/three_seeds", seeds=3, envs=2)
more.train()
for path in sorted(policies.iterdir()):
    kept = saved.get(path.name) == path.stat().st_mtime_ns
    print(path.name, "as it was" if kept else "new")

# %%
# It is the same after an interruption: ``--resume`` continues a training from its last saved state,
# and plays the rows that are missing.
#
# Nothing depends on who computes
# -------------------------------
# Here is one seed again, elsewhere, in a single worker. If the number of workers had a say, the
# weights would differ in the last bits.

alone = compare("alone/run", seeds=1, envs=1)
alone.train()
for contestant in alone.contestants:
    (same,) = [
        other
        for other in more.contestants
        if other.facts() == contestant.facts()
    ]
    pairs = zip(
        contestant.policy().parameters(),
        same.policy().parameters(),
        strict=True,
    )
    equal = all(torch.equal(one, other) for one, other in pairs)
    print(contestant.method.label, "has the same weights:", equal)

# %%
# What the cells are for: the spread between seeds is part of the result.

figure, axis = plt.subplots(figsize=(6, 2.4))
for place, (method, color) in enumerate(
    zip(more.methods, ("#7f7f7f", "#1f77b4"), strict=True)
):
    rates = [
        judge_navigation(c.policy(), seed=0, nfe=3, rollouts=128)
        for c in more.contestants
        if c.method == method
    ]
    rates = [row["collision_rate"] for row in rates]
    axis.plot(rates, [place] * len(rates), "o", color=color, ms=8)
axis.set_yticks([0, 1], [method.label for method in more.methods])
axis.set(xlabel="episodes that collide, NFE 3", xlim=(-0.03, 1.03))
axis.set(ylim=(-0.5, 1.5), title="Three training seeds of each source")
plt.show()
folder.cleanup()

# %%
# How far that goes
# -----------------
# ``python benchmarks/scaling.py POLICY`` plays a saved policy in one and more processes, and from the
# recorded durations of its decisions and control steps puts together what more cores would take.
# These numbers are WP-Past's on square, 24 episodes, two cores, at commit 9447452: how many times as
# fast as one core, and the seconds that were measured.

cores = [1, 2, 4, 8, 16, 32, 64]
simulated = {
    "comparison": [1.0, 2.0, 4.0, 8.0, 15.99, 30.14, 53.45],
    "apart": [1.0, 1.956, 3.854, 7.223, 13.03, 23.92, 44.93],
    "lockstep": [1.043, 1.588, 2.665, 4.338, 6.573, 12.2, 22.09],
}
seconds = {"apart": [12.9, 6.917], "lockstep": [17.0, 12.65]}

figure, axis = plt.subplots(figsize=(6, 3.6))
lines = {
    "comparison": ("a whole comparison", "tab:green"),
    "apart": ("episodes apart, as here", "tab:blue"),
    "lockstep": ("episodes in lockstep", "tab:orange"),
}
axis.plot(cores, cores, ":", color="0.6", label="ideal")
for name, (label, color) in lines.items():
    axis.plot(cores, simulated[name], "o-", color=color, ms=4, label=label)
for name, measured in seconds.items():
    axis.plot(
        cores[:2],
        [seconds["apart"][0] / one for one in measured],
        "x",
        color=lines[name][1],
        ms=9,
        mew=2,
    )
axis.plot([], [], "x", color="black", label="measured (the rest: simulated)")
axis.set(xscale="log", yscale="log", xlabel="cores")
axis.set(ylabel="times as fast as one core")
axis.set_xticks(cores, cores)
axis.set_yticks(cores, cores)
axis.minorticks_off()
axis.legend()
plt.show()

# %%
# What to notice: only the crosses were measured, at one and two cores. Lockstep is what a
# vectorised environment does: at every decision all wait for the slowest, and in the end for the
# longest episode; its crosses lie below its line, for what the exchange between processes costs is
# not simulated. Episodes apart lose at the end alone, and a whole comparison has so many of them
# that it hardly matters. :doc:`/scaling` has the numbers, and what they leave out.
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
# ``--out`` is a folder that all machines see at the same path. A lost machine costs what it was
# doing: Ray starts its jobs again elsewhere, and a training goes on from its last state. If the one
# that drives is lost, the run is continued, with Ray or without:
#
# .. code-block:: console
#
#    python benchmarks/robomimic.py --resume --out /shared/runs/square
#
# One large network
# -----------------
# Where a single training is what takes long, several processes share its batches. The weights are
# those of one process up to rounding, and any number of processes goes on from a saved state:
#
# .. code-block:: console
#
#    torchrun --nproc-per-node 2 benchmarks/robomimic.py --preset paper --device cuda
#    torchrun --nproc-per-node 8 benchmarks/robomimic.py --resume --out runs/square-ph-paper
#
# On CPUs that does not pay: two processes reached 0.64 times twice the speed of one with the paper's
# transformer, and less with small networks. None of it has been run on a GPU, or on more than one
# physical machine: what was tested, and where, stands in :doc:`/scaling`.
