"""How the system schedules this process, where a library has changed it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["scheduled_as_before"]


@contextmanager
def scheduled_as_before() -> Iterator[None]:
    """Undo what libraries do to the scheduling of the thread that calls them.

    The AV1 encoder that LeRobot writes videos with gives a process of the superuser real-time priority, and
    with it all workers that are started later: beside them everything else on the machine stands still.

    Examples:
        >>> import os
        >>> with scheduled_as_before():
        ...     pass
        >>> not hasattr(os, "SCHED_OTHER") or os.sched_getscheduler(0) == os.SCHED_OTHER
        True
    """
    if not hasattr(os, "sched_setscheduler"):  # of Linux
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if os.sched_getscheduler(0) != before[0]:
            os.sched_setscheduler(0, *before)
