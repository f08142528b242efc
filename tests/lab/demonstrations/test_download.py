from collections import Counter

import pytest

pytest.importorskip("huggingface_hub")

from lab.demonstrations.downloads import REPOSITORIES, download_robomimic
from tests.data.synthetic import write_robomimic_file
from tests.errors import refuses
from tests.io.hub_server import Loopback, etag, reachable

FIRST = REPOSITORIES[0]
FILE = "v1.5/square/ph/low_dim_v15.hdf5"


class Hub(Loopback):
    """``files`` maps (repository, path) to (announced length, body); some repositories send another one."""

    def __init__(self):
        self.files, self.sent, self.requests = {}, {}, Counter()
        super().__init__()

    def answer(self, method, path, body, allowed):
        repository, _, file = path.removeprefix("/datasets/").partition("/resolve/main/")
        self.requests[method, repository] += 1
        if (repository, file) not in self.files:
            return 404, {"X-Error-Code": "RepoNotFound"}, b""
        announced, content = self.files[repository, file]
        headers = {"ETag": f'"{etag(content)}"', "X-Linked-Size": str(announced), "X-Repo-Commit": "a" * 40}
        return 200, headers, self.sent.get(repository, content)

    def put(self, repository, content, announced=None):
        self.files[repository, FILE] = (announced or len(content), content)


@pytest.fixture
def hub(monkeypatch):
    server = Hub()
    reachable(monkeypatch, server.address)
    yield server
    server.close()


@pytest.fixture(scope="module")
def content(tmp_path_factory):
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
    "shorter than announced": (lambda content: content[:-5000], True, "size"),
    "cut short at the source": (lambda content: content[:-5000], False, "HDF5"),
    "damaged on the way": (lambda content: content[:-100] + b"?" + content[-99:], None, "sha256"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_file_is_refused_and_does_not_stay_in_the_way(hub, content, tmp_path, kind):
    change, announced, fact = BROKEN[kind]
    for repository in REPOSITORIES:
        if announced is None:
            hub.put(repository, content)
            hub.sent[repository] = change(content)
        else:
            hub.put(repository, change(content), len(content) if announced else None)
    refuses(lambda: download_robomimic("square", root=tmp_path), OSError, fact, "force=True")
    hub.sent = {}
    hub.put(FIRST, content)
    path = download_robomimic("square", root=tmp_path)
    assert path.read_bytes() == content
    path.write_bytes(change(content))  # on the disk, afterwards
    assert download_robomimic("square", root=tmp_path).read_bytes() == content


@pytest.mark.parametrize(
    ("args", "there"),
    [
        (["stack"], "lift, can, square, transport, tool_hang, stack_d0"),
        (["lift", "mg"], "ph, mh"),
        (["coffee_d0", "ph"], "source, core"),
    ],
)
def test_unknown_task_or_style_asks_nobody(hub, args, there):
    refuses(lambda: download_robomimic(*args), ValueError, f"'{args[-1]}'", there)
    assert not hub.requests
