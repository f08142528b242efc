"""The columns of rows and tables: meaning and number format of each, defined once.

Rows are those of `results.jsonl` and `curvature.jsonl`; tables have means over training seeds. A report ends
with the meanings of its columns.
"""

from __future__ import annotations

# Name -> (format of its numbers, meaning).
_COMPARED: dict[str, tuple[str, str]] = {
    "task": ("", "task"),
    "data": ("", "style of the demonstrations, such as ph or mh"),
    "actions": ("", "space of the actions, if they are not the recorded deltas"),
    "obs": ("", "observations of the policy, if they are not the state"),
    "prior": ("", "method, as --prior names it"),
    "options": ("", "options of the method that differ from their defaults"),
    "sigma": ("g", "standard deviation of the source around its mean"),
    "chunk": ("d", "chunk length H"),
    "seed": ("d", "training seed; empty for a mean over several"),
    "iterations": ("d", "length of the training in iterations"),
    "policy": ("", "folder of the policy in policies/, or method"),
    "checkpoint": ("d", "iteration of the training at which the policy was saved"),
    "nfe": ("d", "network evaluations per chunk"),
    "temperature": ("g", "factor of the source's noise at decisions"),
    "execute": ("d", "actions executed per decision"),
    "delay": ("d", "control steps until a chunk takes effect"),
    "guidance": ("", "rtc: guided by Real-Time Chunking"),
    "algorithm": ("", "how the agent learns"),
    "centre": ("", "centre of the agent's box: the mean of the source, or zero"),
    "delta": ("g", "half the side of the agent's box"),
    "environment_steps": ("d", "control steps that the agent has collected"),
    "evaluation": ("", "base: the frozen policy, around zero from N(0, I); greedy: the agent"),
    "mean": ("", "history of the source: training (the data's), or deployed (from the policy's prediction)"),
}

IDENTITY = tuple(_COMPARED)
"""The columns that identify a row: no two rows of a file agree in all of them."""

COLUMNS: dict[str, tuple[str, str]] = {
    "setting": ("", "task and style in words"),
    "method": ("", "method in words, with its options, and with sigma and H if several are compared"),
    **_COMPARED,
    "run": ("", "folder of the run, if there are several"),
    "observations": ("d", "number of observations that were averaged"),
    # Success.
    "episodes": ("d", "evaluation episodes of the last checkpoint; in tables summed over seeds"),
    "successes": ("d", "episodes solved"),
    "success_rate": (".1%", "share of episodes solved"),
    "outcomes": ("", "1 (solved) or 0 for every episode, in the order of their seeds"),
    "first_episode": ("d", "simulator seed of the first episode; each training seed has its own"),
    "success": (
        ".1%",
        "success rate: per seed the mean of the best --top-k checkpoints, chosen on other episodes",
    ),
    "seeds": ("d", "training seeds"),
    "checkpoints": ("d", "checkpoints per training"),
    "gain": ("+.1%", "success minus the first method's at the same NFE"),
    "gains": ("", "the gain of each training"),
    "one_sigma": ("", "true if the gain exceeds the sum of both deviations over seeds (the paper's rule)"),
    "won": (".6g", "episodes that this method solves and the first one does not, at equal seeds"),
    "lost": (".6g", "episodes that the first method solves and this one does not, at equal seeds"),
    "paper": (".1%", "the paper's success rate, on the official demonstrations"),
    "paper_ratio": (".3f", "the paper's ratio of curvatures, on the official demonstrations"),
    "mean_steps": (".1f", "control steps per episode"),
    "action_error": (".4f", "mean squared error of executed actions on held-out demonstrations"),
    # Jumps and distances, in normalised action units.
    "boundary_jump": (".3f", "mean distance between consecutive actions where a chunk takes effect"),
    "inner_jump": (".3f", "mean distance between consecutive actions inside a chunk"),
    "jump_ratio": (".3f", "boundary_jump over inner_jump"),
    "mean_error": (".3f", "RMS distance from the source's mean to the demonstrated actions"),
    "mean_revision_data": (".3f", "RMS distance from the source's mean to the prediction, on data"),
    "mean_revision": (".3f", "RMS distance from the source's mean to the prediction, in episodes"),
    # What reaches the actions, on 512 observations of the training data.
    "source_leak": (
        ".2f",
        "spread of actions over source samples, divided by the data's; (!) above 1: noise gets through",
    ),
    "inner_step_ratio": (".2f", "step between actions of a chunk, divided by the data's; (!) above 1.3"),
    "memory_gain": (
        "z.3f",
        "how far actions move when the past or forecast is shifted (0: ignored, 1: copied)",
    ),
    # The flow.
    "kappa": (".3f", "curvature of the flow (in results.jsonl over the executed positions)"),
    "relative_curvature": (".3f", "curvature over the executed positions / squared mean velocity"),
    "relative": (".3f", "curvature / squared mean velocity"),
    "speed": (".3f", "squared mean velocity"),
    "one_step_error": (".3f", "root mean square error of one Euler step"),
    "bound": (".2f", "bound of the branching cost (in results.jsonl over the executed positions)"),
    "coverage": (".2f", "share of demonstrated actions inside the source's 90% interval"),
    "ratio": (".3f", "kappa over the first policy's, with a 95% bootstrap interval over episodes"),
    "ratio_executed": (".3f", "kappa_executed over the first policy's, with a 95% bootstrap interval"),
    "ratio_relative": (".3f", "relative_executed over the first policy's, with a 95% bootstrap interval"),
    "ratio_one_step": (".3f", "one_step_error_executed over the first policy's, with its 95% interval"),
    "training_seconds": (".0f", "processor time of the training in seconds, including its teacher's"),
    # The toy.
    "switch_rate": (".3f", "share of chunk boundaries at which the robot changes sides"),
    "commit_rate": (".3f", "share of rollouts that stay on one side"),
    "collision_rate": (".3f", "share of rollouts that enter an obstacle"),
    "route_entropy": (".3f", "entropy of the routes, in bits"),
    "recombination_rate": (".3f", "share of rollouts on a route that no demonstration takes"),
    "distance": (".3f", "mean distance to the height of the nearest demonstration"),
    "jump": (".3f", "mean change of height at chunk boundaries"),
    "jerk": (".3f", "mean norm of the third difference of executed actions"),
}

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


def column(name: str) -> tuple[str, str]:
    """Return format and meaning of a column; raise KeyError for an unknown one."""
    if name in COLUMNS:
        return COLUMNS[name]
    if name.startswith("episode_"):
        return ".3f", "measure of the task with this name, averaged over episodes"
    for end, words in ENDS.items():
        whole = name.removesuffix(end).removeprefix(end)
        if whole != name and whole in COLUMNS:
            return ".2f" if end == "_ratio" else COLUMNS[whole][0], f"{whole}: {words}"
    raise KeyError(f"no column is called {name!r}: add it to COLUMNS, with its format and meaning")
