"""What is learnt from demonstrations, and how it is played."""

from warmprior.tasks.task import Play, Task

__all__ = [
    "Play",
    "Task",
]
