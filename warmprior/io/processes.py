"""Worker processes that end with whoever started them."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time

__all__ = ["end_with_parent"]


def end_with_parent() -> None:
    """Let this process end when the one that started it dies, however abruptly.

    A killed process cannot tell its workers to stop, and they would wait for hours: its ends of their
    pipes stay open in whatever else it forked later. The main process is left alone.
    """
    if multiprocessing.parent_process() is None:
        return
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)  # nobody is left to be told, and the environment may be in the middle of a step

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()
