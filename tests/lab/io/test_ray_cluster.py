"""A Ray cluster: what is none, and machines that could not do the work, are refused at once."""

import contextlib
import socket
import sys
import time

import pytest

from lab.io import ray_cluster as module
from lab.io.ray_cluster import check_ray, ray_cluster
from tests.errors import raises, refuses
from tests.processes import apart

pytest.importorskip("ray")


@pytest.mark.slow  # a cluster takes most of a minute to start, and minutes on a busy machine
@apart
def test_machines_look_for_modules_where_this_process_does(ray_address, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "users_own_module.py").write_text("def answer():\n    return 42\n")
    import users_own_module

    with ray_cluster(ray_address, folders=[tmp_path]) as ray:
        assert ray.get(ray.remote(users_own_module.answer).remote()) == 42
        with ray_cluster() as same:  # the connection that is there
            assert same is ray
        assert ray.is_initialized()
    assert not ray.is_initialized() and not list(tmp_path.glob(".shared-*"))


@pytest.mark.slow
@apart
def test_a_cluster_of_this_machine_alone_is_reached_from_no_other(monkeypatch):
    import psutil

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with ray_cluster(num_cpus=1) as ray:
        assert ray.get(ray.remote(lambda: 42).remote()) == 42
        me, listening = psutil.Process(), {}
        for process in (me, *me.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                for socket_ in process.net_connections(kind="inet"):
                    if socket_.status == psutil.CONN_LISTEN:
                        listening[socket_.laddr.port] = socket_.laddr.ip.removeprefix("::ffff:")
    assert len(listening) >= 4, "where are the head, the node, this process and a worker?"
    assert set(listening.values()) <= {"127.0.0.1", "::1"}


def test_what_is_no_cluster_is_refused_within_seconds(monkeypatch):
    started = time.monotonic()
    refuses(lambda: check_ray("127.0.0.1:1"), ConnectionError, "127.0.0.1:1", "ray start --head")
    for address in ("localhost", "ray://head:10001"):
        with raises(ValueError, "HOST:PORT"):
            check_ray(address)
    assert time.monotonic() - started < 5
    monkeypatch.setattr(module, "PATIENCE", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{silent.getsockname()[1]}")
        refuses(lambda: check_ray(), ConnectionError, "0.5 seconds")
    monkeypatch.delenv("RAY_ADDRESS")
    assert check_ray() is None


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    for attempt in (check_ray, lambda: ray_cluster().__enter__()):
        with raises(ImportError, "warmprior[ray]"):
            attempt()
