"""The pictures of a comparison: posteriors, learning curves, and an episode of every method."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

import pandas as pd

from lab.demonstrations.loading import title_of
from lab.options.options import Options
from lab.reporting.plots import plot_filmstrip, plot_learning_curves, plot_success
from lab.reporting.report import at_fewest, labelled, per_seed
from lab.running.policies import Policy
from warmprior.envs.rendering import rendering_backend
from warmprior.evaluation import record_filmstrip


def tasks_of(policies: Sequence[Policy]) -> dict[tuple[str, str], list[Policy]]:
    """Return the policies by name and style of their task, in their order."""
    tasks: dict[tuple[str, str], list[Policy]] = {}
    for policy in policies:
        tasks.setdefault((policy.facts["task"], policy.facts["data"]), []).append(policy)
    return tasks


def draw(options: Options, policies: Sequence[Policy], rows: pd.DataFrame) -> None:
    """Draw posteriors of the success rates, and learning curves, per task."""
    tasks, out = tasks_of(policies), options.run.folder
    for (task, style), of_task in tasks.items():
        suffix = f"_{task}_{style}" if len(tasks) > 1 else ""
        task_rows = labelled(rows[(rows.task == task) & (rows.data == style)])
        if task_rows.empty:
            continue
        played = [p for p in of_task if p.name in set(task_rows.policy)]
        chunks = ", ".join(map(str, sorted(set(task_rows.chunk))))
        title = f"{title_of(played[0].task())}, H = {chunks}"
        seeds = per_seed(task_rows, options.evaluation.top_k)
        if task_rows["temperature"].nunique() > 1:
            seeds["nfe"] = [
                f"NFE {n}, noise x {t:g}" for n, t in zip(seeds["nfe"], seeds["temperature"], strict=True)
            ]
        plot_success(seeds, out / f"success{suffix}.png", title=title)
        label = dict(zip(task_rows.policy, task_rows.method, strict=True))
        fewest = at_fewest(task_rows)
        fewest = fewest[fewest.temperature == fewest.groupby("method").temperature.transform("max")]
        losses: dict[str, list[list[tuple[int, float]]]] = {}
        for policy in played:
            if policy.state.is_file():
                losses.setdefault(label[policy.name], []).append(policy.losses)
            else:
                print(f"No learning curve of {policy}: {policy.state} is missing")
        if losses:
            plot_learning_curves(losses, fewest, out / f"learning_curves{suffix}.png", title=title)


def films(options: Options, policies: Sequence[Policy]) -> dict[str, Callable[[], str | None]]:
    """Return, by the names of the policies to film, the calls that do it: per task and method the first."""
    calls: dict[str, Callable[[], str | None]] = {}
    tasks = tasks_of(policies) if options.run.videos else {}
    for (task, style), of_task in tasks.items():
        first = of_task[0].task()
        if "robosuite" in (first.environment or {}) and rendering_backend() is None:
            print(
                "No filmstrips: neither EGL nor OSMesa works here. Install one (on Debian or Ubuntu apt-get "
                "install libegl1 libegl-mesa0, or libosmesa6)."
            )
        elif first.environment is not None or first.play.video_rate is not None:
            methods = labelled(pd.DataFrame([policy.facts for policy in of_task]))["method"]
            suffix = f"_{task}_{style}" if len(tasks) > 1 else ""
            for method, policy in dict(reversed([*zip(methods, of_task, strict=True)])).items():
                calls[policy.name] = partial(film, options, policy, method, suffix)
    return calls


def film(options: Options, policy: Policy, method: str, suffix: str) -> str | None:
    """Record a film; return why there is none."""
    try:
        video(options, policy, method, suffix)
    except Exception as error:  # a user's environment may fail in any way
        return f"No filmstrip of {method}: {error}"
    return None


def video(options: Options, policy: Policy, method: str, suffix: str) -> None:
    """Record the first evaluation episode of a policy as a filmstrip and, with PyAV, as a video."""
    nfe, task, actor = min(policy.method.nfes(options.evaluation.nfe)), policy.task(), policy.load()
    if policy.method.is_flow:
        actor = actor.replace(temperature=max(options.evaluation.temperature))
    first = options.evaluation.starts(policy.training.seed).start
    slug = re.sub(r"[^\w.]+", "-", method if "," in method else policy.method.name)
    video = options.run.folder / f"video_{slug}{suffix}.mp4"
    env_options: dict[str, Any] = options.evaluation.environment
    if task.environment is None:
        env_options = {"env": task.env(actor), "rate": task.play.video_rate, "success": task.play.success}
    strip = record_filmstrip(
        actor,
        seed=first,
        nfe=nfe,
        policy_seed=policy.training.seed,
        video=video if find_spec("av") else None,
        **env_options,
    )
    outcome = "solved" if strip.success else "not solved"
    plot_filmstrip(
        strip.frames,
        [f"step {step}" for step in strip.steps],
        options.run.folder / f"filmstrip_{slug}{suffix}.png",
        title=f"{method}, NFE {nfe}, episode {first}: {outcome}",
    )
