"""Episodes that policies play, in worker processes too, and their videos."""

from warmprior.evaluation.episodes import Episode, evaluate, play_episode
from warmprior.evaluation.parallel import parallel_env
from warmprior.evaluation.video import Filmstrip, record_filmstrip
from warmprior.io.workers import WorkerError

__all__ = [
    "Episode",
    "Filmstrip",
    "WorkerError",
    "evaluate",
    "parallel_env",
    "play_episode",
    "record_filmstrip",
]
