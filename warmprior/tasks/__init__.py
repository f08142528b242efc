"""What is learnt from demonstrations, and how it is played."""

from warmprior.tasks.task import Task

__all__ = [
    "Task",
]
