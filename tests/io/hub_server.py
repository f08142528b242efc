"""A server on the loopback interface that keeps model repositories as the hub does, for its own client."""

import base64
import hashlib
import json
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

TOKEN = "hf_loopback"
"""Who has it may write, and read what is private."""


class Loopback:
    """A server that replies what ``answer`` gives for a request: a status, headers and content."""

    def __init__(self):
        hub = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                if self.headers.get("Transfer-Encoding") == "chunked":
                    while size := int(self.rfile.readline(), 16):
                        body += self.rfile.read(size)
                        self.rfile.readline()
                    self.rfile.readline()
                allowed = self.headers.get("Authorization") == f"Bearer {TOKEN}"
                path = self.path.partition("?")[0]
                status, headers, content = hub.answer(self.command, path, body, allowed)
                if not isinstance(content, bytes):
                    content = json.dumps(content).encode()
                self.send_response(status)
                for name, value in (headers | {"Content-Length": str(len(content))}).items():
                    self.send_header(name, value)
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(content)

            do_HEAD = do_POST = do_PUT = do_GET

            def log_message(self, *args): ...

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_port}"
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()

    def close(self):
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


def reachable(monkeypatch, address: str) -> None:
    """Let the hub's client go to a server of the loopback interface."""
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    constants = "huggingface_hub.constants."
    monkeypatch.setattr(constants + "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants + "ENDPOINT", address)
    template = address + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants + "HUGGINGFACE_CO_URL_TEMPLATE", template)


class Repository:
    def __init__(self, private):
        self.private, self.branches, self.commits = private, {}, {}
        self.commit("main", {})

    def commit(self, branch: str, files: dict[str, bytes]) -> str:
        before = self.commits.get(self.branches.get(branch, ""), {})
        name = hashlib.sha1(f"{branch} {len(self.commits)}".encode()).hexdigest()
        self.commits[name] = before | files
        self.branches[branch] = name
        return name

    def at(self, revision: str) -> str | None:
        revision = self.branches.get(revision, revision)
        return revision if revision in self.commits else None


class ModelHub(Loopback):
    """Repositories by name, and the requests that were made, as ``"METHOD path"``."""

    def __init__(self):
        self.repositories, self.objects, self.requests = {}, {}, []
        super().__init__()

    def files(self, name: str, revision: str = "main") -> dict[str, bytes]:
        repository = self.repositories[name]
        return repository.commits[repository.at(revision)]

    def answer(self, method, path, body, allowed):
        self.requests.append(f"{method} {path}")
        if path == "/api/validate-yaml":
            return 200, {}, {"errors": [], "warnings": []}
        if path.startswith("/objects/"):
            self.objects[path.removeprefix("/objects/")] = body
            return 200, {}, b""
        if path == "/api/repos/create":
            return self._create(json.loads(body), allowed)
        found = re.match(r"(?:/api/models)?/([^/]+/[^/.]+)(?:\.git)?(?:/(.*))?$", path)
        name, (what, _, rest) = found[1], (found[2] or "").partition("/")
        repository = self.repositories.get(name)
        if repository is None or (repository.private and not allowed):
            return (404 if allowed else 401), {"X-Error-Code": "RepoNotFound"}, b""
        if method == "POST" and not allowed:
            return 403, {"X-Error-Message": "no permission"}, b""
        if what == "preupload":
            paths = [file["path"] for file in json.loads(body)["files"]]
            modes = ["lfs" if path.endswith(".safetensors") else "regular" for path in paths]
            files = [
                {"path": path, "uploadMode": mode, "shouldIgnore": False}
                for path, mode in zip(paths, modes, strict=True)
            ]
            return 200, {}, {"files": files}
        if what == "info" and rest.startswith("lfs"):
            objects = [
                o | {"actions": {"upload": {"href": f"{self.address}/objects/{o['oid']}"}}}
                for o in json.loads(body)["objects"]
            ]
            return 200, {}, {"transfer": "basic", "objects": objects}
        if what == "commit":
            return self._commit(name, rest, body)
        if what == "branch":
            repository.branches.setdefault(rest, repository.branches["main"])
            return 200, {}, {}
        revision, _, file = rest.partition("/")
        commit = repository.at(revision or "main")
        if commit is None:
            return 404, {"X-Error-Code": "RevisionNotFound"}, b""
        if what in ("", "revision"):
            return 200, {}, {"id": name, "sha": commit, "private": repository.private, "tags": []}
        files = repository.commits[commit]
        if what == "tree":
            listed = [
                {"type": "file", "path": path, "size": len(content), "oid": etag(content)}
                for path, content in files.items()
            ]
            return 200, {}, listed
        if file not in files:
            return 404, {"X-Error-Code": "EntryNotFound", "X-Repo-Commit": commit}, b""
        content = files[file]
        return 200, {"ETag": f'"{etag(content)}"', "X-Repo-Commit": commit}, content

    def _create(self, asked, allowed):
        if not allowed:
            return 401, {}, {"error": "no token"}
        name = f"{asked['organization']}/{asked['name']}"
        known = name in self.repositories
        if not known:
            private = asked.get("visibility") == "private" or bool(asked.get("private"))
            self.repositories[name] = Repository(private)
        return 409 if known else 200, {}, {"url": f"{self.address}/{name}"}

    def _commit(self, name, branch, body):
        files = {}
        for line in map(json.loads, body.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.objects[value["oid"]]
        oid = self.repositories[name].commit(branch, files)
        url = f"{self.address}/{name}/commit/{oid}"
        return 200, {}, {"commitUrl": url, "commitOid": oid, "hookOutput": ""}


def etag(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@contextmanager
def model_hub(monkeypatch, cache):
    """A hub for the client, which has an empty cache and no token of its own."""
    server = ModelHub()
    reachable(monkeypatch, server.address)
    for name in ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    constants = "huggingface_hub.constants."
    monkeypatch.setattr(constants + "HF_HUB_DISABLE_XET", True)  # files go by git-lfs's protocol
    monkeypatch.setattr(constants + "HF_HUB_CACHE", str(cache / "hub"))
    monkeypatch.setattr(constants + "HF_TOKEN_PATH", str(cache / "no_token"))
    try:
        yield server
    finally:
        server.close()
