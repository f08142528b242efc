import functools
import gc
import multiprocessing
import os
import pickle
import traceback
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path

import torch

from warmprior.io.workers import end_with_parent


def ended(pid):
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().split()[2] == "Z"


def apart(function):
    """Let a function or test run in a process forked for it, and give its result or error.

    Whatever renders in a test does it there: OpenGL does not survive a fork, and the tests' own process
    forks workers that render.
    """

    @functools.wraps(function)
    def call(*args, **kwargs):
        fork = multiprocessing.get_context("fork")
        ours, theirs = fork.Pipe(duplex=False)

        def work():
            gc.freeze()  # what has threads, as video decoders have, ends in the process that they are in
            end_with_parent(os.getppid())
            torch.set_num_threads(1)  # it would wait for those of the process before, which are not here
            try:
                outcome = function(*args, **kwargs), None
            except BaseException as error:  # pytest's own outcomes included
                error.add_note(traceback.format_exc())
                outcome = None, error
            theirs.send(outcome)

        gc.collect()
        process = fork.Process(target=work)
        process.start()
        theirs.close()
        try:
            result, error = ours.recv()
        finally:
            process.join()
        if error is not None:
            raise error
        return result

    return call


@contextmanager
def here(count, state):
    """``lab.io.workers.working`` in this process, where others would take seconds to start.

    State and jobs are pickled, as for others.
    """
    state = pickle.loads(pickle.dumps(state))

    def call(job):
        future = Future()
        try:
            future.set_result(pickle.loads(pickle.dumps(job))(state))
        except Exception as error:
            future.set_exception(error)
        return future

    yield call
