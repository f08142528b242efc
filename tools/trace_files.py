"""Count the modules of warmprior that a training on steps in memory enters.

python tools/trace_files.py            # prints them, and their number
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType

import torch
from tensordict import TensorDict

import warmprior
from warmprior import PastPrior
from warmprior.training import TrainingConfig, train_policy

PACKAGE = Path(warmprior.__file__).parent


def main() -> None:
    """Train for two iterations, and print every file whose functions were called."""
    steps = {"observation": torch.rand(60, 3), "action": torch.rand(60, 1), "episode": torch.arange(60) // 20}
    entered: set[str] = set()

    def enter(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            entered.add(frame.f_code.co_filename)

    def train() -> None:
        recipe = TrainingConfig(iterations=2)
        train_policy(TensorDict(steps, [60]), PastPrior(4), training=recipe, description=None)

    train()  # what is imported on the way runs now
    sys.setprofile(enter)
    train()
    sys.setprofile(None)
    inside = sorted(
        str(Path(name).relative_to(PACKAGE)) for name in entered if Path(name).is_relative_to(PACKAGE)
    )
    print(*inside, sep="\n")
    print(f"{len(inside)} files")


if __name__ == "__main__":
    main()
