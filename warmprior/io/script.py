"""Scripts: their options come before PyTorch; an error that a user can mend, and Ctrl-C, become one line."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

from warmprior.io.distributed import joined, launched, rank
from warmprior.io.workers import WorkerError

ERRORS = (ValueError, KeyError, OSError, ImportError, FloatingPointError, WorkerError)
"""Errors that a user can mend are reported without a traceback."""


def run_script(
    script: Callable[[], object],
    name: str,
    *,
    errors: tuple[type[BaseException], ...] = ERRORS,
    together: bool = False,
    hint: str = "",
) -> int:
    """Run a script of this name; its exit code: 0, 2 after one of ``errors``, 130 after Ctrl-C.

    ``together`` allows several processes that ``torchrun`` starts, of which the first prints. ``hint`` says
    how to go on after Ctrl-C.

    Examples:
        >>> import sys
        >>> from contextlib import redirect_stderr
        >>> from warmprior.io.script import run_script
        >>> run_script(lambda: print("trained"), "train.py")
        trained
        0
        >>> with redirect_stderr(sys.stdout):
        ...     run_script(lambda: int("eight"), "train.py")
        train.py: error: invalid literal for int() with base 10: 'eight'
        2
    """
    interrupted = False

    def interrupt(number: int, frame: Any) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        if launched() and not together:
            raise ValueError("it trains with one process; start it without torchrun")
        if launched():  # processes join before the options are read
            start_pytorch()
        with joined(), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere if rank() else sys.stdout):
            script()
    except BaseException as error:
        if interrupted:  # whatever the libraries in between have made of it
            sys.stderr.write(f"\n{name}: interrupted{hint and '; '}{hint}\n")
            return 130
        if not isinstance(error, errors):
            raise
        message = error.args[0] if isinstance(error, KeyError) and error.args else error
        teller = f"{name} (process {os.environ['RANK']})" if launched() else name
        sys.stderr.write(f"{teller}: error: {message}\n")
        return 2
    finally:
        signal.signal(signal.SIGINT, before)
    return 0


def read_command_line[T](parse: Callable[[], T]) -> T:
    """Read a command line with tyro or argparse, as ``parse`` does, and start PyTorch; help does without it.

    Unknown options are reported, and the process exits.

    Raises:
        ValueError: if an option has a value that its dataclass refuses.
    """
    stderr = io.StringIO()
    try:
        with redirect_stderr(stderr):
            try:
                options = parse()
            finally:
                sys.stdout.flush()
    except BrokenPipeError:  # the reader of the help, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at its end
        raise SystemExit(128 + signal.SIGPIPE) from None
    except SystemExit as stop:
        cause: Any = stop.__context__
        if isinstance(getattr(cause, "arg", None), str):
            raise ValueError(str(cause.message)) from None
        sys.stderr.write(stderr.getvalue())
        raise
    start_pytorch()
    return options


def start_pytorch() -> None:
    """Import PyTorch, which takes seconds, and say so; set what all scripts share.

    Policies are shared between scripts, so all of them use the same precision and threads. Small networks are
    no faster with a second thread, and on a busy machine threads that wait for each other cost much.
    """
    if "torch" not in sys.modules:
        sys.stderr.write("importing PyTorch\n")
    import torch

    torch.set_float32_matmul_precision("high")
    torch.set_num_threads(1)
