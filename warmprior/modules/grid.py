"""Where the steps of a sampler lie between the source and the data."""

from __future__ import annotations

__all__ = ["check_grid", "grid_parts"]

JUMP = 0.5
"""Where the dense steps of ``dense-jump`` end; Chen et al. saw fields pull towards training actions later."""


def check_grid(grid: str) -> None:
    """A ``ValueError`` if no grid has this name, or its jump does not start in (0, 1)."""
    _jump(grid)


def grid_parts(grid: str, steps: int, *, start_time: float = 0.0) -> list[tuple[float, float, int]]:
    r"""The parts of a grid; within each the steps are equally long.

    - ``"uniform"``: one part.
    - ``"dense-jump"``: all steps but one up to :math:`t_j`, and the last from there to ``t = 1`` (Dense-Jump
      Flow Matching, Chen et al., 2025, arXiv:2509.13574). It avoids late steps, which pull towards actions of
      the training data, and is meant for networks trained at ``u-shaped`` times. :math:`t_j` is half way from
      ``start_time`` to 1; ``"dense-jump:0.7"`` moves it.

    One step is the same on every grid.

    Args:
        grid: its name.
        steps: of the sampler.

    Keyword Args:
        start_time: where the sampler starts.

    Returns:
        Begin, end and number of steps of each part.

    Raises:
        ValueError: see :func:`check_grid`.

    See Also:
        :func:`~warmprior.integrate`: takes its steps on such a grid.

    Examples:
        >>> from warmprior.modules.grid import grid_parts
        >>> grid_parts("dense-jump:0.75", 4), grid_parts("dense-jump", 1)
        ([(0.0, 0.75, 3), (0.75, 1.0, 1)], [(0.0, 1.0, 1)])
    """
    share = _jump(grid)
    if share is None or steps == 1:
        return [(start_time, 1.0, steps)]
    jump = start_time + share * (1.0 - start_time)
    return [(start_time, jump, steps - 1), (jump, 1.0, 1)]


def _jump(grid: str) -> float | None:
    """Share of the way before the jump; ``None`` without a jump."""
    if grid == "uniform":
        return None
    name, colon, number = str(grid).partition(":")
    if name != "dense-jump":
        raise ValueError(
            f"unknown grid {grid!r}; choose one of uniform, dense-jump, or dense-jump:TIME with a time in "
            "(0, 1)"
        )
    try:
        share = float(number) if colon else JUMP
    except ValueError:
        share = float("nan")
    if not 0.0 < share < 1.0:
        raise ValueError(f"the jump of a grid must start in (0, 1), got {grid!r}")
    return share
