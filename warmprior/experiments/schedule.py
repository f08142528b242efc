"""Which job of a comparison is next, and which policies a failure ends."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

from warmprior.experiments.worker import Job, Measure, Play, PlayCell, Train

__all__ = ["Schedule"]


class Schedule:
    """The jobs that are left, as policies are trained, or fail.

    A policy is measured and played before the next is trained. Only the last trainings start at once, for
    they take longest and nothing should wait for them. Teachers are trained before who learns from them.

    Args:
        order: numbers of the policies, in the order in which to train them.
        following: by number, what follows the training; nothing by default.

    Keyword Args:
        teachers: by number, the policy that another one learns from.
        workers: how many jobs run at once at most.
        trainings_at_once: how many of them may be trainings; any number by default.

    Examples:
        >>> schedule = Schedule([0, 1], {1: [Measure(1)]}, teachers={0: 1}, workers=2)
        >>> schedule.next(), schedule.next()  # the pupil waits
        (Train(number=1), None)
        >>> schedule.trained(1)
        >>> schedule.next(), schedule.next(), schedule.next()
        (Train(number=0), Measure(number=1), None)
    """

    def __init__(
        self,
        order: Sequence[int],
        following: Mapping[int, Sequence[Measure | Play | PlayCell]],
        *,
        teachers: Mapping[int, int],
        workers: int,
        trainings_at_once: int | None = None,
    ) -> None:
        self._following, self._teachers = following, teachers
        self._workers = workers
        self._at_once = trainings_at_once or len(order)
        self._to_train, self._ready = deque(map(Train, order)), deque[Measure | Play | PlayCell]()
        self._training = 0
        self._tried = set[int]()  # whose training ended, well or not
        self._failed = set[int]()

    def next(self) -> Job | None:
        """The next job, which starts now; ``None`` if it has to wait for others, or none is left."""
        training = self._next_training()
        if training is not None:
            self._to_train.remove(training)
            self._training += 1
            return training
        return self._ready.popleft() if self._ready else None

    def _next_training(self) -> Train | None:
        """The first that needs no policy which is still to be trained."""
        if self._training >= self._at_once or (self._ready and len(self._to_train) > self._workers):
            return None
        free = (
            job for job in self._to_train if self._teachers.get(job.number) in {None, *self._tried}
        )
        return next(free, None)

    def trained(self, number: int) -> None:
        """A policy is trained: what follows may start, and its pupils' training."""
        self._end_training(number)
        self._ready.extend(self._following.get(number, ()))

    def failed(self, job: Job) -> list[int]:
        """A job failed, or is not begun: nothing more is done for its policy and those that learn from it.

        Args:
            job: the one that failed.

        Returns:
            The numbers of these policies, its own first; each is told once.
        """
        if isinstance(job, Train) and job not in self._to_train:
            self._end_training(job.number)
        pupils = [pupil for pupil, teacher in self._teachers.items() if teacher == job.number]
        new = [number for number in (job.number, *pupils) if number not in self._failed]
        self._failed.update(new)
        self._to_train = deque(j for j in self._to_train if j.number not in self._failed)
        self._ready = deque(j for j in self._ready if j.number not in self._failed)
        return new

    def _end_training(self, number: int) -> None:
        self._training -= 1
        self._tried.add(number)
