"""Connections to a Ray cluster, whose machines are checked."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import socket
import subprocess
import sys
import uuid
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest import mock

from lab.io.workers import available_cores
from warmprior.io.extras import require
from warmprior.io.files import write_atomic
from warmprior.io.workers import WorkerError, stop_forking

PATIENCE = 60.0
"""Seconds that a cluster has to answer; each machine has three times as long to import this library."""

CONNECT = "import ray, sys; ray.init(address=sys.argv[1], log_to_driver=False)"
"""The code of a process that tests the connection."""


def check_ray(address: str | None = None) -> str | None:
    """Check that a cluster can be reached, and return its address.

    Args:
        address: ``HOST:PORT`` of its head, or ``auto``; by default ``$RAY_ADDRESS``.

    Returns:
        The address, or ``None`` for a cluster of this machine alone, which has to be started.

    Raises:
        ValueError: if the address has another form.
        ConnectionError: if the cluster does not answer.
    """
    require("ray", "ray")
    option = "--ray-address" if address else "RAY_ADDRESS"
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    if address == "local":
        return None
    host, _, port = address.rpartition(":")
    if address != "auto" and not (host and port.isdecimal() and "/" not in host):
        raise ValueError(
            f"{option} {address} is not the address of a cluster's head, HOST:PORT (6379 by default); "
            "start from one of its machines, not through ray://"
        )
    try:
        if address != "auto":  # fails at once if nothing listens
            socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()
        # In a separate process, because Ray retries for minutes and cannot be interrupted.
        command = [sys.executable, "-c", CONNECT, address]
        process = subprocess.run(command, stderr=subprocess.PIPE, timeout=PATIENCE, check=False)
        if process.returncode == 0:
            return address
        reason = reason_of(process.stderr)
    except subprocess.TimeoutExpired as late:
        reason = f"it does not answer within {PATIENCE:g} seconds. {reason_of(late.stderr or b'')}"
    except (OSError, OverflowError) as error:
        reason = str(error)
    raise ConnectionError(
        f"{option} {address} is no cluster that answers: {reason.strip(' .')}. Start one with ray start "
        "--head (RAY_AUTH_MODE=token if it asks for a token), or leave out --ray-address and RAY_ADDRESS for "
        "this machine alone"
    )


def reason_of(text: bytes) -> str:
    """Return the last error message in the output of a Python process or of Ray."""
    return re.split(r"^[\w.]+(?:Error|Exception): |^\[.*?\] ", text.decode(), flags=re.M)[-1].strip()


def check_versions(local: Mapping[str, str], remote: Mapping[str, str], node: str) -> None:
    """Raise WorkerError if a machine has other versions, which might give other results.

    Examples:
        >>> from lab.io.ray_cluster import check_versions
        >>> check_versions({"torch": "2.11.0"}, {"torch": "2.10.0"}, "node-7")
        Traceback (most recent call last):
            ...
        warmprior.io.workers.WorkerError: node-7 has torch 2.10.0, and this process 2.11.0: ...
    """
    for name, local_version in local.items():
        remote_version = remote.get(name, "none")
        if remote_version != local_version:
            raise WorkerError(
                f"{node} has {name} {remote_version}, and this process {local_version}: install the same "
                "version everywhere"
            )


def versions() -> dict[str, str]:
    """Return the versions that have to be the same on all machines."""
    packages = ("warmprior", "torch", "torchrl", "tensordict")
    return {"Python": platform.python_version(), **{name: version(name) for name in packages}}


def _look(tokens: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """Return a machine's versions, and the files of ``tokens`` that it does not see as written."""

    def content(path: str) -> str | None:
        try:
            return Path(path).read_text()
        except OSError:
            return None

    return versions(), [path for path, token in tokens.items() if content(path) != token]


@contextlib.contextmanager
def ray_cluster(
    address: str | None = None, num_cpus: int | None = None, folders: Sequence[Path] = ()
) -> Iterator[Any]:
    """Connect to a Ray cluster, check its machines, and yield the module ``ray``.

    An existing connection of this process is used and left open. Without an address (see :func:`check_ray`) a
    cluster of this machine is started, and ended afterwards. All machines have to share the ``folders``.

    Raises:
        WorkerError: if a machine has other versions or cannot start the library.
        OSError: if a machine does not see a folder.
    """
    ray = require("ray", "ray")
    with contextlib.ExitStack() as stack:
        if not ray.is_initialized():
            address = check_ray(address)
            # Workers import modules from the same places as this process.
            path = os.pathsep.join(map(os.path.abspath, sys.path))
            options: dict[str, Any] = {
                "address": address or "local",
                "runtime_env": {"env_vars": {"PYTHONPATH": path}},
            }
            if address is None:
                cores = num_cpus or available_cores()
                options |= {"num_cpus": cores, "include_dashboard": False}
            stop_forking()  # a connection does not survive a fork
            stack.callback(ray.shutdown)
            with _unreachable() if address is None else contextlib.nullcontext():
                ray.init(**options, logging_level="ERROR")
        with _tokens(folders) as tokens:
            nodes = [n for n in ray.nodes() if n["Alive"] and n["Resources"].get("CPU", 0) >= 1]
            looks = [_look_at(ray, node, tokens) for node in nodes]  # all at once: each takes seconds
            for node, look in zip(nodes, looks, strict=True):
                _check_node(ray, node, look)
        yield ray


@contextlib.contextmanager
def _unreachable() -> Iterator[None]:
    """Let Ray's processes listen on this machine's loopback only, because they run any code they are sent.

    Ray does so only if its support of clusters is off; otherwise it replaces a loopback address by one that
    other machines reach.
    """
    from ray._private import ray_constants

    local = {ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR: "0"}  # for the processes that it starts
    with mock.patch.dict(os.environ, local), mock.patch.object(ray_constants, "ENABLE_RAY_CLUSTER", False):
        yield


def _look_at(ray: Any, node: Mapping[str, Any], tokens: Mapping[str, str]) -> Any:
    """Start :func:`_look` on a machine."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
    return ray.remote(_look).options(num_cpus=0, scheduling_strategy=strategy).remote(tokens)


def _check_node(ray: Any, node: Mapping[str, Any], look: Any) -> None:
    name = f"Ray's node {node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
    try:
        remote, unseen = ray.get(look, timeout=3 * PATIENCE)
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None) or error
        raise WorkerError(f"{name} cannot start this library: {cause}") from error
    check_versions(versions(), remote, name)
    if unseen:
        raise OSError(
            f"{name} does not see what is written to {Path(unseen[0]).parent} here: choose an --out that "
            "all machines share, at the same path"
        )


@contextlib.contextmanager
def _tokens(folders: Sequence[Path]) -> Iterator[dict[str, str]]:
    """Write a new file to each folder; yield their content by path."""
    token = uuid.uuid4().hex
    paths = [folder.absolute() / f".shared-{token}" for folder in folders]
    try:
        for path in paths:
            write_atomic(path, lambda temporary: temporary.write_text(token))
        yield {str(path): token for path in paths}
    finally:
        for path in paths:
            path.unlink(missing_ok=True)
