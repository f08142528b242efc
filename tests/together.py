import os
import socket

import torch
import torch.multiprocessing

from warmprior.io.distributed import joined
from warmprior.io.workers import start_method


def _run(number, processes, port, job, folder):
    torch.set_num_threads(1)
    os.environ |= {
        "RANK": str(number),
        "LOCAL_RANK": str(number),
        "WORLD_SIZE": str(processes),
        "LOCAL_WORLD_SIZE": str(processes),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    with joined():
        job(folder)


def together(job, folder, processes=2, join=True):
    """Call ``job(folder)`` in each of them; ``join=False`` returns while they run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return torch.multiprocessing.start_processes(
        _run, (processes, port, job, folder), processes, join, start_method=start_method()
    )
