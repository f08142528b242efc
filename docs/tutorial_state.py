"""The state from which every tutorial starts, whatever ran before."""

from __future__ import annotations

import logging
import os
import random
import warnings
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch

# Nothing is fetched while the pages are built, and nobody watches bars or logs.
os.environ |= {
    "HF_HUB_OFFLINE": "1",
    "HF_DATASETS_DISABLE_PROGRESS_BARS": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "RL_LOGGING_LEVEL": "WARNING",
}
# LeRobot logs at length where the libraries of its video decoder are missing.
logging.getLogger("lerobot").setLevel(logging.ERROR)

STYLE = {
    "figure.dpi": 100,
    "savefig.dpi": 100,
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def reset(gallery_conf: Any, fname: str) -> None:
    """Seeds, threads and the style of figures; sphinx-gallery calls it before each script."""
    warnings.filterwarnings("ignore", "Cannot enable progress bars")
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    plt.rcParams.update(STYLE)
