"""A stand-in for the Hugging Face hub's HTTP interface, for commits and downloads."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

TOKEN = "hf_valid"
COMMIT = "0" * 40


class Hub:
    """What the stand-in has received, and how it answers.

    Attributes:
        committed: the files by path, after all commits.
        created: the request that created the repository; None before it.
        card_error: what is wrong with the head of every card.
        public: whether the repository already exists and is public.
        downloaded: the paths of the files that were sent, in order.
    """

    def __init__(self) -> None:
        self.committed: dict[str, bytes] = {}
        self.created: dict[str, Any] | None = None
        self.card_error = ""
        self.public = False
        self.downloaded: list[str] = []
        self.url = ""

    def answer(self, path: str, body: bytes) -> tuple[int, Any]:
        """Status and JSON for a request."""
        if path == "/api/repos/create":
            self.created = json.loads(body)
            name = f"{self.created['organization']}/{self.created['name']}"
            return (409 if self.public else 200), {"url": f"{self.url}/{name}"}
        if path == "/api/validate-yaml" and self.card_error:
            return 400, {"errors": [{"message": self.card_error}], "warnings": []}
        if "/preupload/" in path:
            names = [file["path"] for file in json.loads(body)["files"]]
            modes = [{"path": n, "uploadMode": "regular", "shouldIgnore": False} for n in names]
            return 200, {"files": modes}
        if "/commit/" in path:
            repo = path.removeprefix("/api/models/").split("/commit/")[0]
            return 200, self._commit(body, repo)
        if "/tree/" in path:
            return 200, [
                {"type": "file", "path": name, "size": len(content), "oid": COMMIT}
                for name, content in sorted(self.committed.items())
            ]
        name = path.removeprefix("/api/models/").partition("/revision/")[0]
        found: dict[str, Any] = {"id": name, "sha": COMMIT}
        files = [{"rfilename": name} for name in sorted(self.committed)]
        return 200, found | {"private": not self.public, "siblings": files}

    def file(self, path: str) -> bytes | None:
        """The content to download for a path; None if there is no such file."""
        _, resolve, name = path.partition("/resolve/")
        return self.committed.get(name.partition("/")[2]) if resolve else None

    def _commit(self, body: bytes, repo: str) -> dict[str, Any]:
        for line in body.splitlines():
            entry = json.loads(line)
            if entry["key"] == "file":
                value = entry["value"]
                self.committed[value["path"]] = base64.b64decode(value["content"])
            if entry["key"] == "deletedFile":
                del self.committed[entry["value"]["path"]]
        url = f"{self.url}/{repo}/commit/{COMMIT}"
        return {"success": True, "commitOid": COMMIT, "commitUrl": url}


def _handler(hub: Hub) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self._reply(self._body())

        def do_GET(self) -> None:
            if (content := hub.file(self.path)) is None:
                self._reply(b"")
            else:
                self._file(content)

        do_HEAD = do_GET

        def _file(self, content: bytes) -> None:
            self.send_response(200)
            self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
            self.send_header("X-Repo-Commit", COMMIT)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content)
                hub.downloaded.append(self.path.partition("/resolve/")[2].partition("/")[2])

        def _body(self) -> bytes:
            if self.headers.get("Transfer-Encoding") != "chunked":
                return self.rfile.read(int(self.headers.get("Content-Length", 0)))
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)

        def _reply(self, body: bytes) -> None:
            allowed = self.headers.get("authorization") == f"Bearer {TOKEN}"
            refused = 401, {"error": "Invalid username or password."}
            status, said = hub.answer(self.path, body) if allowed else refused
            content = json.dumps(said).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None:
            pass

    return Handler


@contextmanager
def serving() -> Iterator[Hub]:
    """A stand-in that listens on a free port of this machine."""
    hub = Hub()
    server = HTTPServer(("127.0.0.1", 0), _handler(hub))
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """The stand-in in place of the hub, with a token that it accepts."""
    from huggingface_hub import constants

    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    with serving() as found:
        monkeypatch.setattr(constants, "ENDPOINT", found.url)
        files = found.url + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", files)
        yield found
