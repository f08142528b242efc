"""One load in a process of its own: what came of it, how long it took and how much memory."""

import contextlib
import os
import pickle
import resource
import select
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

LIMIT_SECONDS = 60.0
LIMIT_BYTES = 2 * 2**30


@dataclass(frozen=True)
class Outcome:
    """What came of one case.

    Attributes:
        kind: ``"equal"``, ``"as stored"``, ``"refused"`` or a failure: ``"silent"``, ``"unclear"``,
            ``"hang"``, ``"memory"`` or ``"crash"``.
        detail: the error, or what differed.
    """

    kind: str
    detail: str = ""

    @property
    def failed(self) -> bool:
        return self.kind not in ("equal", "as stored", "refused")


def attempt(load: Callable[[], Outcome], names: str) -> Outcome:
    """Load in a fork of this process, and judge what that raises: a clear error names the damaged path."""
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(ours)
        inherited = _pages()[1]  # counts as its own from the start
        outcome = _judge(load, names)
        with contextlib.suppress(OSError):
            os.write(theirs, pickle.dumps((inherited, outcome.kind, outcome.detail[:600])))
        os._exit(0)
    os.close(theirs)
    ready, _, _ = select.select([ours], [], [], LIMIT_SECONDS)
    answer = os.read(ours, 65_536) if ready else b""
    os.close(ours)
    if not ready:
        os.kill(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    if not ready:
        return Outcome("hang", f"no answer within {LIMIT_SECONDS:.0f} s")
    if not answer:
        return Outcome("crash", f"ended with status {status}")
    inherited, *found = pickle.loads(answer)
    outcome = Outcome(*found)
    taken = 1024 * usage.ru_maxrss - inherited
    if taken > LIMIT_BYTES:
        return Outcome("memory", f"{taken / 2**30:.1f} GiB, then {outcome}")
    return outcome


def _pages() -> tuple[int, int]:
    """Bytes that this process has mapped, and those of them that are in memory."""
    with open("/proc/self/statm") as file:
        mapped, resident = (int(pages) * resource.getpagesize() for pages in file.read().split()[:2])
    return mapped, resident


def _judge(load: Callable[[], Outcome], names: str) -> Outcome:
    # Twice the limit beyond what is mapped already: what asks for more is refused by the system.
    resource.setrlimit(resource.RLIMIT_AS, (_pages()[0] + 2 * LIMIT_BYTES,) * 2)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    started = time.monotonic()
    try:
        return load()
    except (ValueError, OSError) as error:
        text = f"{type(error).__name__}: {error}"
        clear = names in str(error) and len(text) < 4000
        return Outcome("refused" if clear else "unclear", text)
    except BaseException as error:
        return Outcome("unclear", f"{type(error).__name__}: {error} ({time.monotonic() - started:.1f} s)")
