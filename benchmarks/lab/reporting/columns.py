"""The columns of rows and tables: meaning and number format of each, defined once.

Rows are those of `results.jsonl` and `curvature.jsonl`; tables have means over training seeds. A report ends
with the meanings of its columns. Their values come from `row` (`running/policies.py`), `measure`
(`running/measuring.py`) and, over several rows, `summary` (`report.py`).
"""

from __future__ import annotations

from typing import Literal, NamedTuple


class Column(NamedTuple):
    """A column of rows and tables.

    Attributes:
        form: format of its numbers, "" for text.
        meaning: what it says, in the report's last lines.
        shown: if it stands below the success rates of report.md, and how: as it is, or as its ratio to the
            first method's, a column of its own that ends in _ratio.
    """

    form: str
    meaning: str
    shown: Literal["no", "as is", "as ratio"] = "no"


_COMPARED: dict[str, Column] = {
    "task": Column("", "task"),
    "data": Column("", "style of the demonstrations, such as ph or mh"),
    "actions": Column("", "space of the actions, if they are not the recorded deltas"),
    "obs": Column("", "observations of the policy, if they are not the state"),
    "prior": Column("", "method, as --prior names it"),
    "options": Column("", "options of the method that differ from their defaults"),
    "sigma": Column("g", "standard deviation of the source around its mean"),
    "chunk": Column("d", "chunk length H"),
    "seed": Column("d", "training seed; empty for a mean over several"),
    "iterations": Column("d", "length of the training in iterations"),
    "policy": Column("", "folder of the policy in policies/, or method"),
    "checkpoint": Column("d", "iteration of the training at which the policy was saved"),
    "nfe": Column("d", "network evaluations per chunk"),
    "temperature": Column("g", "factor of the source's noise at decisions"),
    "execute": Column("d", "actions executed per decision"),
    "delay": Column("d", "control steps until a chunk takes effect"),
    "guidance": Column("", "rtc: guided by Real-Time Chunking"),
    "algorithm": Column("", "how the agent learns"),
    "centre": Column("", "centre of the agent's box: the mean of the source, or zero"),
    "delta": Column("g", "half the side of the agent's box"),
    "environment_steps": Column("d", "control steps that the agent has collected"),
    "evaluation": Column("", "base: the frozen policy, around zero from N(0, I); greedy: the agent"),
    "mean": Column(
        "", "history of the source: training (the data's), or deployed (from the policy's prediction)"
    ),
}

IDENTITY = tuple(_COMPARED)
"""The columns that identify a row: no two rows of a file agree in all of them."""

COLUMNS: dict[str, Column] = {
    "setting": Column("", "task and style in words"),
    "method": Column("", "method in words, with its options, and with sigma and H if several are compared"),
    **_COMPARED,
    "run": Column("", "folder of the run, if there are several"),
    "observations": Column("d", "number of observations that were averaged"),
    # Success.
    "episodes": Column("d", "evaluation episodes of the last checkpoint; in tables summed over seeds"),
    "successes": Column("d", "episodes solved"),
    "success_rate": Column(".1%", "share of episodes solved"),
    "outcomes": Column("", "1 (solved) or 0 for every episode, in the order of their seeds"),
    "first_episode": Column("d", "simulator seed of the first episode; each training seed has its own"),
    "success": Column(
        ".1%",
        "success rate: per seed the mean of the best --top-k checkpoints, chosen on other episodes",
        shown="as is",
    ),
    "seeds": Column("d", "training seeds"),
    "checkpoints": Column("d", "checkpoints per training"),
    "gain": Column("+.1%", "success minus the first method's at the same NFE", shown="as is"),
    "gains": Column("", "the gain of each training"),
    "one_sigma": Column(
        "", "true if the gain exceeds the sum of both deviations over seeds (the paper's rule)"
    ),
    "won": Column(
        ".6g", "episodes that this method solves and the first one does not, at equal seeds", shown="as is"
    ),
    "lost": Column(
        ".6g", "episodes that the first method solves and this one does not, at equal seeds", shown="as is"
    ),
    "paper": Column(".1%", "the paper's success rate, on the official demonstrations"),
    "paper_ratio": Column(".3f", "the paper's ratio of curvatures, on the official demonstrations"),
    "mean_steps": Column(".1f", "control steps per episode"),
    "action_error": Column(".4f", "mean squared error of executed actions on held-out demonstrations"),
    # What reaches the actions, on 512 observations of the training data.
    "source_leak": Column(
        ".2f",
        "spread of actions over source samples, divided by the data's; (!) above 1: noise gets through",
        shown="as is",
    ),
    "inner_step_ratio": Column(
        ".2f", "step between actions of a chunk, divided by the data's; (!) above 1.3", shown="as is"
    ),
    "memory_gain": Column(
        "z.3f",
        "how far actions move when the past or forecast is shifted (0: ignored, 1: copied)",
        shown="as is",
    ),
    # Jumps, in normalised action units.
    "boundary_jump": Column(
        ".3f", "mean distance between consecutive actions where a chunk takes effect", shown="as is"
    ),
    "inner_jump": Column(".3f", "mean distance between consecutive actions inside a chunk", shown="as is"),
    "jump_ratio": Column(".3f", "boundary_jump over inner_jump"),
    # The flow.
    "kappa": Column(
        ".3f", "curvature of the flow (in results.jsonl over the executed positions)", shown="as ratio"
    ),
    "relative_curvature": Column(
        ".3f", "curvature over the executed positions / squared mean velocity", shown="as ratio"
    ),
    "relative": Column(".3f", "curvature / squared mean velocity"),
    "speed": Column(".3f", "squared mean velocity"),
    "one_step_error": Column(".3f", "root mean square error of one Euler step"),
    "bound": Column(
        ".2f", "bound of the branching cost (in results.jsonl over the executed positions)", shown="as ratio"
    ),
    "ratio": Column(".3f", "kappa over the first policy's, with a 95% bootstrap interval over episodes"),
    "ratio_executed": Column(".3f", "kappa_executed over the first policy's, with a 95% bootstrap interval"),
    "ratio_relative": Column(
        ".3f", "relative_executed over the first policy's, with a 95% bootstrap interval"
    ),
    "ratio_one_step": Column(".3f", "one_step_error_executed over the first policy's, with its 95% interval"),
    "training_seconds": Column(
        ".0f", "processor time of the training in seconds, including its teacher's", shown="as ratio"
    ),
    # The source; distances in normalised action units.
    "coverage": Column(
        ".2f", "share of demonstrated actions inside the source's 90% interval", shown="as is"
    ),
    "mean_error": Column(
        ".3f", "RMS distance from the source's mean to the demonstrated actions", shown="as is"
    ),
    "mean_revision_data": Column(
        ".3f", "RMS distance from the source's mean to the prediction, on data", shown="as is"
    ),
    "mean_revision": Column(
        ".3f", "RMS distance from the source's mean to the prediction, in episodes", shown="as is"
    ),
    # The toy.
    "switch_rate": Column(".3f", "share of chunk boundaries at which the robot changes sides"),
    "commit_rate": Column(".3f", "share of rollouts that stay on one side"),
    "collision_rate": Column(".3f", "share of rollouts that enter an obstacle"),
    "route_entropy": Column(".3f", "entropy of the routes, in bits"),
    "recombination_rate": Column(".3f", "share of rollouts on a route that no demonstration takes"),
    "distance": Column(".3f", "mean distance to the height of the nearest demonstration"),
    "jump": Column(".3f", "mean change of height at chunk boundaries"),
    "jerk": Column(".3f", "mean norm of the third difference of executed actions"),
}

RELATIVE = [name for name, column in COLUMNS.items() if column.shown == "as ratio"]
"""The columns that are also compared with the first method's."""

SHOWN = [
    f"{name}_ratio" if name in RELATIVE else name for name, column in COLUMNS.items() if column.shown != "no"
]
"""The columns below the success rates of report.md, in the order of their lines here."""

# Beginnings and ends of names, and what they mean.
ENDS = {
    "_executed": "over the executed positions",
    "shifted_": "with the history shifted",
    "_std": "standard deviation over training seeds",
    # Of success and gain by the spread between trainings; with one training each for its episodes alone.
    "_low": "lower end of the 95% interval over trainings",
    "_high": "upper end of the 95% interval",
    "_ratio": "divided by the first method's",
}


def column(name: str) -> Column:
    """Return a column by its name; raise KeyError for an unknown one."""
    if name in COLUMNS:
        return COLUMNS[name]
    if name.startswith("episode_"):
        return Column(".3f", "measure of the task with this name, averaged over episodes")
    for end, words in ENDS.items():
        whole = name.removesuffix(end).removeprefix(end)
        if whole != name and whole in COLUMNS:
            return Column(".2f" if end == "_ratio" else COLUMNS[whole].form, f"{whole}: {words}")
    raise KeyError(f"no column is called {name!r}: add it to COLUMNS, with its format and meaning")
