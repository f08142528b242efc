"""The pictures of a comparison: posteriors, learning curves, and an episode of every method."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import pandas as pd

from lab.options import Options
from lab.plots import plot_filmstrip, plot_learning_curves, plot_success
from lab.policies import Policy
from lab.report import at_fewest, labelled, per_seed
from lab.tasks import title_of
from warmprior.envs.rendering import rendering_backend
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.training import record_filmstrip


def draw(options: Options, policies: Sequence[Policy], rows: pd.DataFrame) -> None:
    """Per task: posteriors of the success rates, learning curves, and an episode of every method."""
    tasks = list(dict.fromkeys((p.facts["task"], p.facts["data"]) for p in policies))
    out = options.run.folder
    for task, style in tasks:
        end = f"_{task}_{style}" if len(tasks) > 1 else ""
        mine = labelled(rows[(rows.task == task) & (rows.data == style)])
        if mine.empty:
            continue
        played = [p for p in policies if p.name in set(mine.policy)]
        chunks = ", ".join(map(str, sorted(set(mine.chunk))))
        title = f"{title_of(played[0].task())}, H = {chunks}"
        seeds = per_seed(mine, options.evaluation.top_k)
        if mine["temperature"].nunique() > 1:
            seeds["nfe"] = [
                f"NFE {n}, noise x {t:g}" for n, t in zip(seeds["nfe"], seeds["temperature"], strict=True)
            ]
        plot_success(seeds, out / f"success{end}.png", title=title)
        label = dict(zip(mine.policy, mine.method, strict=True))
        losses: dict[str, list[list[tuple[int, float]]]] = {}
        for policy in played:
            losses.setdefault(label[policy.name], []).append(policy.losses)
        fewest = at_fewest(mine)
        fewest = fewest[fewest.temperature == fewest.groupby("method").temperature.transform("max")]
        plot_learning_curves(losses, fewest, out / f"learning_curves{end}.png", title=title)
        task = played[0].task()
        if not options.run.videos:
            continue
        if "robosuite" in (task.environment or {}) and rendering_backend() is None:
            print(
                "No filmstrips: neither EGL nor OSMesa works here. On Debian or Ubuntu: "
                "apt-get install libegl1 libegl-mesa0 (or libosmesa6)."
            )
        elif task.environment is not None or task.video_rate is not None:
            for method, policy in {label[p.name]: p for p in reversed(played)}.items():
                try:
                    video(options, policy, method, end)
                except Exception as error:  # other people's environments draw in their own ways, or not
                    print(f"No filmstrip of {method}: {error}")


def video(options: Options, policy: Policy, method: str, end: str) -> None:
    """The first evaluation episode of a policy, in pictures and, with PyAV, as a video."""
    nfe, task = min(policy.method.nfes(options.evaluation.nfe)), policy.task()
    slug = re.sub(r"[^\w.]+", "-", method if "," in method else policy.method.name)
    video = options.run.folder / f"video_{slug}{end}.mp4"
    own: dict[str, Any] = options.evaluation.environment
    if task.environment is None:
        own = {"env": task.env(policy.load()), "rate": task.video_rate, "success": task.success}
    strip = record_filmstrip(
        policy.load(),
        seed=EVALUATION_SEED,
        nfe=nfe,
        policy_seed=policy.training.seed,
        video=video if find_spec("av") else None,
        **own,
    )
    outcome = "solved" if strip.success else "not solved"
    plot_filmstrip(
        strip.frames,
        [f"step {step}" for step in strip.steps],
        options.run.folder / f"filmstrip_{slug}{end}.png",
        title=f"{method}, NFE {nfe}, episode {EVALUATION_SEED}: {outcome}",
    )
