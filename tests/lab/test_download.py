from __future__ import annotations

import hashlib
from collections import Counter

import pytest

from lab.downloads import REPOSITORIES, download_robomimic
from tests.data.synthetic import write_robomimic_file
from tests.io.hub_server import Loopback, reachable

pytest.importorskip("huggingface_hub")

FIRST = REPOSITORIES[0]
FILE = "v1.5/square/ph/low_dim_v15.hdf5"


class Hub(Loopback):
    """A server on the loopback interface that answers as the hub's file addresses do.

    ``files`` maps (repository, path) to (announced length, body); ``missing`` is the error code for
    everything else.
    """

    def __init__(self) -> None:
        self.files: dict[tuple[str, str], tuple[int, bytes]] = {}
        self.missing = "RepoNotFound"
        self.sent: dict[str, bytes] = {}  # by repository, instead of what is announced
        self.requests: Counter[tuple[str, str]] = Counter()
        super().__init__()

    def answer(self, request) -> None:
        parts = request.path.split("/resolve/main/")
        repository = parts[0].removeprefix("/datasets/")
        self.requests[request.command, repository] += 1
        found = self.files.get((repository, parts[-1]))
        if found is None:
            request.send_response(404)
            request.send_header("X-Error-Code", self.missing)
            request.send_header("X-Repo-Commit", "b" * 40)
            request.send_header("Content-Length", "0")
            request.end_headers()
            return
        body = request.command == "GET"
        announced, content = found
        digest = hashlib.sha256(content).hexdigest()
        content = self.sent.get(repository, content)
        request.send_response(200)
        request.send_header("ETag", f'"{digest}"')
        request.send_header("X-Repo-Commit", "a" * 40)
        request.send_header("X-Linked-Size", str(announced))
        request.send_header("Content-Length", str(len(content)))
        request.end_headers()
        if body:
            request.wfile.write(content)

    def put(self, repository: str, content: bytes, announced: int | None = None) -> None:
        self.files[repository, FILE] = (announced or len(content), content)


@pytest.fixture
def hub(monkeypatch):
    server = Hub()
    reachable(monkeypatch, server.address)
    yield server
    server.close()


@pytest.fixture(scope="module")
def content(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("hub") / "file.hdf5"
    write_robomimic_file(path)
    return path.read_bytes()


def test_is_fetched_once(hub, content, tmp_path):
    hub.put(FIRST, content)
    path = download_robomimic("square", root=tmp_path)
    assert download_robomimic("square", root=tmp_path) == path
    assert hub.requests["GET", FIRST] == 1
    download_robomimic("square", force=True, root=tmp_path)
    assert hub.requests["GET", FIRST] == 2
    hub.close()  # what is there serves without a connection
    assert download_robomimic("square", root=tmp_path) == path


BROKEN = {
    "shorter than announced": (lambda content: content[:-5000], True, "should be of size"),
    "cut short at the source": (lambda content: content[:-5000], False, "not a readable HDF5 file"),
    "damaged on the way": (lambda content: content[:-100] + b"?" + content[-99:], None, "sha256"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_file_is_refused_and_does_not_stay_in_the_way(hub, content, tmp_path, kind):
    change, announced, said = BROKEN[kind]
    for repository in REPOSITORIES:
        if announced is None:
            hub.put(repository, content)
            hub.sent[repository] = change(content)
        else:
            hub.put(repository, change(content), len(content) if announced else None)
    with pytest.raises(OSError, match=rf"(?s){said}.*force=True"):
        download_robomimic("square", root=tmp_path)
    hub.sent = {}
    hub.put(FIRST, content)
    path = download_robomimic("square", root=tmp_path)
    assert path.read_bytes() == content
    path.write_bytes(change(content))  # on the disk, afterwards
    assert download_robomimic("square", root=tmp_path).read_bytes() == content


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["stack"], "choose one of lift, can, square, transport, tool_hang, stack_d0"),
        (["lift", "mg"], "'mg' data; it has: ph, mh"),
        (["coffee_d0", "ph"], "no official 'ph' data; it has: source, core"),
    ],
)
def test_unknown_task_or_style_asks_nobody(hub, args, said):
    with pytest.raises(ValueError, match=said):
        download_robomimic(*args)
    assert not hub.requests
