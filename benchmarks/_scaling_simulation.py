"""How long work would take on more cores than there are: recorded durations, put together anew."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from warmprior.experiments.schedule import Schedule
from warmprior.experiments.worker import Job, Train

Decide = Callable[[int], float]
"""Seconds in which a policy decides for as many episodes at once."""


@dataclass(frozen=True)
class Played:
    """An episode as it was recorded.

    Attributes:
        decisions: seconds that each decision took, alone.
        steps: seconds until the environment needed the next one, or had ended; with the reset first.
    """

    decisions: tuple[float, ...]
    steps: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """The whole episode, played by one process."""
        return sum(self.decisions) + sum(self.steps)


def apart(episodes: Sequence[Played], cores: int) -> float:
    """Each process plays whole episodes: whoever is free takes the next."""
    free = [0.0] * cores
    for episode in episodes:
        heapq.heapreplace(free, free[0] + episode.seconds)
    return max(free)


def lockstep(episodes: Sequence[Played], cores: int, decide: Decide) -> float:
    """All rows of a vectorised environment decide together, and the slowest one ends the step.

    Row ``i`` of ``n`` plays the episodes ``i, i + n, i + 2n, ...``.
    """
    rows = [deque(s for e in episodes[i::cores] for s in e.steps) for i in range(cores)]
    total = 0.0
    while any(rows):
        total += decide(cores) + max(row.popleft() for row in rows if row)
    return total


def served(episodes: Sequence[Played], cores: int, decide: Decide) -> float:
    """One process more decides for all episodes that wait for it, whenever it is free."""
    waiting, left = deque(episodes), [deque[float]() for _ in range(cores)]
    events: list[tuple[float, int]] = []  # when each environment needs a decision
    now, end, server_free = 0.0, 0.0, 0.0

    def proceed(row: int, at: float) -> None:
        nonlocal end
        if not left[row]:
            end = max(end, at)
            if not waiting:
                return
            left[row].extend(waiting.popleft().steps)
        # The first step of an episode begins with a decision, as all others do.
        heapq.heappush(events, (at, row))

    for row in range(cores):
        proceed(row, 0.0)
    while events:
        now = max(server_free, events[0][0])
        batch = []
        while events and events[0][0] <= now:
            batch.append(heapq.heappop(events)[1])
        server_free = now + decide(len(batch))
        for row in batch:
            proceed(row, server_free + left[row].popleft())
    return end


def comparison(
    policies: int, training: float, following: Callable[[int], Mapping[Job, float]], cores: int
) -> float:
    """A whole comparison: its own schedule, with recorded durations.

    Args:
        policies: how many are trained.
        training: seconds of a training.
        following: what follows the training of a policy, with the seconds that it takes.
        cores: worker processes, each on a core of its own.
    """
    jobs = {number: dict(following(number)) for number in range(policies)}
    schedule = Schedule(
        range(policies),
        {number: list(durations) for number, durations in jobs.items()},  # type: ignore[arg-type]
        teachers={},
        workers=cores,
    )
    now, running = 0.0, list[tuple[float, int, Job]]()
    count = 0
    while True:
        while len(running) < cores and (job := schedule.next()) is not None:
            seconds = training if isinstance(job, Train) else jobs[job.number][job]
            heapq.heappush(running, (now + seconds, count, job))
            count += 1
        if not running:
            return now
        now, _, job = heapq.heappop(running)
        if isinstance(job, Train):
            schedule.trained(job.number)
