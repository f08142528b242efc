"""Success rates in parallel environments, the same episodes for every policy."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ParallelEnv, TransformedEnv
from torchrl.envs.transforms import Compose
from tqdm import tqdm

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor

__all__ = ["Episode", "evaluate", "parallel_env"]


class WorkerError(RuntimeError):
    """A worker process of an environment died."""


@dataclass(frozen=True)
class Episode:
    """Outcome of one evaluation episode.

    Attributes:
        seed: simulator seed of the reset.
        success: whether the task was solved.
        steps: control steps executed.
        decisions: the policy's decisions, ``[D]``: ``("vla_action", "chunk")``, and under ``"next"``
            ``"executed_steps"`` and ``"done"``. Episodes concatenated along ``D`` are a rollout for
            :func:`~warmprior.diagnostics.smoothness`.
    """

    seed: int
    success: bool
    steps: int
    decisions: TensorDictBase = field(compare=False, repr=False)


def _transformed(
    make_env: Callable[[], EnvBase], make_transforms: Callable[[], Compose]
) -> EnvBase:
    _end_with_parent()
    return TransformedEnv(make_env(), make_transforms())


def _end_with_parent() -> None:
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


def parallel_env(
    make_env: Callable[..., EnvBase],
    make_transforms: Callable[[], Compose],
    num_envs: int,
) -> ParallelEnv:
    """Environments in worker processes, with the policy's transforms inside the workers.

    Whole chunks are executed inside a worker, so there is one exchange per decision. Worker ``i`` of
    ``n`` plays the episodes ``i, i + n, i + 2n, ...`` after ``set_seed(seed, static_seed=True)``.

    Args:
        make_env: called as ``make_env(seed_offset=i, seed_stride=n)`` in each worker, see
            :class:`~warmprior.envs.RobosuiteEnv`.
        make_transforms: builds the policy's transforms, see :func:`~warmprior.policy_transforms`.
        num_envs: number of workers.

    Raises:
        ValueError: if ``num_envs < 1``.
    """
    if num_envs < 1:
        raise ValueError(f"the number of environments must be at least 1, got {num_envs}")
    workers = [
        partial(
            _transformed, partial(make_env, seed_offset=i, seed_stride=num_envs), make_transforms
        )
        for i in range(num_envs)
    ]
    # Forking starts in a second instead of a minute, but a process that uses CUDA must not fork.
    # Without shared buffers the parent sleeps while workers simulate; with them it polls and would
    # take a core from the workers.
    method = "spawn" if torch.cuda.is_initialized() else "fork"
    return ParallelEnv(num_envs, workers, mp_start_method=method, use_buffers=False)


@contextmanager
def watched(env: EnvBase) -> Iterator[None]:
    """Turn the death of a worker into an error: TorchRL alone would wait for it for hours."""
    base = env
    while isinstance(base, TransformedEnv):
        base = base.base_env
    if isinstance(base, ParallelEnv) and base.is_closed:
        base.start()
    workers = list(base._workers) if isinstance(base, ParallelEnv) else []
    finished = threading.Event()
    dead: list[str] = []

    def look() -> None:
        for i, worker in enumerate(workers):
            if not dead and not worker.is_alive():
                dead.append(f"worker {i} of {len(workers)} (exit code {worker.exitcode})")

    def watch() -> None:
        while not finished.wait(0.5):
            look()
            if dead:
                for worker in workers:
                    worker.terminate()  # closes the pipes that the parent waits on
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    except BaseException as error:
        if isinstance(error, (ConnectionError, EOFError)):
            for worker in workers:  # TorchRL may notice before the process is reaped
                worker.join(0.2)
        look()
        finished.set()
        # Without this, idle workers would keep the interpreter from exiting.
        try:
            env.close(raise_if_closed=False)
        except Exception:  # closing complains about dead workers itself
            for worker in workers:
                with suppress(ValueError):  # already closed
                    worker.terminate()
        if dead:
            raise WorkerError(
                f"an environment worker died: {dead[0]}. It may have been killed for lack of memory; "
                "use fewer --envs, or run one environment in this process to see its own error."
            ) from error
        raise
    finally:
        finished.set()
        watcher.join()


@contextmanager
def _drawing(policy: TensorDictModuleBase, seed: int, device: torch.device) -> Iterator[None]:
    """Let a policy draw from a seed, and leave all other draws as they were."""
    if isinstance(policy, WarmPriorActor):
        previous = policy.sampler.generator
        policy.sampler.generator = torch.Generator(device).manual_seed(seed)
        try:
            yield
        finally:
            policy.sampler.generator = previous
        return
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


@torch.no_grad()
def evaluate(
    policy: TensorDictModuleBase,
    env: EnvBase,
    *,
    episodes: int,
    first_seed: int,
    nfe: int | None = None,
    policy_seed: int = 0,
    description: str | None = None,
) -> list[Episode]:
    """Play episodes and report each one's outcome.

    Args:
        policy: a :class:`~warmprior.WarmPriorActor`, or any module that writes chunks, such as an agent
            followed by a :class:`~warmprior.PriorDecoder`; set to evaluation mode.
        env: a batched environment ``[n]`` with the policy's transforms, such as :func:`parallel_env`.

    Keyword Args:
        episodes: how many; episode ``e`` starts from simulator seed ``first_seed + e``.
        first_seed: seed of the first episode; keep it away from the data's seeds.
        nfe: network evaluations per chunk of a :class:`~warmprior.WarmPriorActor`; its own by default.
        policy_seed: of the policy's random draws: those of a :class:`~warmprior.WarmPriorActor`, or those
            that another module takes from PyTorch's global generator. The latter goes on afterwards as if
            nothing had been played.
        description: of the progress bar; no bar if ``None``.

    Returns:
        The episodes in order of their seeds. The same arguments and number of environments give the same
        result.

    Raises:
        ValueError: if ``episodes < 1``.
        WorkerError: if a worker process dies, a ``RuntimeError``.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    num_envs = env.batch_size[0]
    policy.eval()
    # Policies without an agent, such as residuals drawn for a decoder, have buffers alone, or nothing.
    tensors = chain(policy.parameters(), policy.buffers())
    device = next((tensor.device for tensor in tensors), torch.device("cpu"))
    options = {} if nfe is None else {"nfe": nfe}
    # The simulators need the cores; a policy's call is small, and its idle threads would spin.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    played = [0] * num_envs
    outcomes: list[Episode] = []
    chunks: list[list[Tensor]] = [[] for _ in played]
    executed: list[list[Tensor]] = [[] for _ in played]
    bar = tqdm(total=episodes, desc=description, unit="ep", disable=description is None)
    try:
        with bar, watched(env), _drawing(policy, policy_seed, device):
            env.set_seed(first_seed, static_seed=True)
            data = env.reset()
            while len(outcomes) < episodes:
                # A worker whose episodes are all played rests; its episode numbers are i + n * played.
                active = torch.tensor(
                    [i + num_envs * played[i] < episodes for i in range(num_envs)]
                )
                if not active.all():
                    data.set("_step", active)
                data = env.step(policy(data.to(device), **options).to("cpu"))
                done = data["next", "done"].flatten() & active
                chunk, steps = data[keys.CHUNK], data["next", keys.EXECUTED]
                for i in active.nonzero().flatten().tolist():
                    chunks[i].append(chunk[i])
                    executed[i].append(steps[i])
                for i in done.nonzero().flatten().tolist():
                    seed = first_seed + i + num_envs * played[i]
                    decisions = _decisions(chunks[i], executed[i])
                    outcomes.append(_outcome(data["next"][i], seed, decisions))
                    chunks[i], executed[i] = [], []
                    played[i] += 1
                    bar.update()
                    wins = sum(outcome.success for outcome in outcomes)
                    bar.set_postfix(success=f"{wins / len(outcomes):.2f}", refresh=False)
                data = env.step_mdp(data)
                if done.any() and len(outcomes) < episodes:
                    data = env.reset(data.set("_reset", done.unsqueeze(-1)))
    finally:
        torch.set_num_threads(threads)
    return sorted(outcomes, key=lambda outcome: outcome.seed)


def _decisions(chunks: list[Tensor], executed: list[Tensor]) -> TensorDict:
    done = torch.zeros(len(chunks), 1, dtype=torch.bool)
    done[-1] = True
    return TensorDict(
        {
            keys.CHUNK: torch.stack(chunks),
            "next": {keys.EXECUTED: torch.stack(executed), "done": done},
        },
        batch_size=[len(chunks)],
    )


def _outcome(data: TensorDictBase, seed: int, decisions: TensorDictBase) -> Episode:
    return Episode(seed, bool(data["success"]), int(data[keys.ELAPSED]), decisions)
