"""A Hugging Face hub on 127.0.0.1: the part of its HTTP interface that Minari and the downloads use, with faults.

Repositories are lists of commits in memory. ``cuts`` says after how many bytes of which file the connection breaks;
``flips`` at which byte a file comes back changed; ``ranges`` whether it honours them.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit

Files = dict[str, bytes]


@dataclass
class Hub:
    """What the stand-in holds, does wrong and was asked."""

    url: str = ""
    repositories: dict[str, list[tuple[str, Files]]] = field(default_factory=dict)
    cuts: dict[str, list[int]] = field(default_factory=dict)
    flips: dict[str, int] = field(default_factory=dict)
    ranges: bool = True
    token: str | None = None
    log: list[tuple[str, str, str]] = field(default_factory=list)

    def commit(self, repository: str, changes: Files) -> str:
        """Adds a commit with these files written and gives its name."""
        history = self.repositories.setdefault(repository, [])
        files = {**(history[-1][1] if history else {}), **changes}
        state = json.dumps([len(history), {path: hashlib.sha256(data).hexdigest() for path, data in files.items()}])
        history.append((hashlib.sha1(state.encode()).hexdigest(), files))
        return history[-1][0]

    def at(self, repository: str, revision: str) -> tuple[str, Files] | None:
        """The commit of a name."""
        history = self.repositories.get(repository, [])
        if revision == "main":
            return history[-1] if history else None
        return next((commit for commit in history if commit[0] == revision), None)

    def fetched(self, name: str) -> list[str]:
        """The Range headers of the GET requests for files that end in ``name``; "" for a whole one."""
        return [bytes_ for method, path, bytes_ in self.log if method == "GET" and "/resolve/" in path and name in path]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        self._answer()

    def do_HEAD(self) -> None:
        self._answer()

    def do_POST(self) -> None:
        self._answer()

    def _answer(self) -> None:
        parts = urlsplit(self.path)
        path, query = unquote(parts.path), parse_qs(parts.query)
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.hub.log.append((self.command, path, self.headers.get("Range", "")))
        if (
            self.command == "POST"
            and self.hub.token
            and self.headers.get("Authorization") != f"Bearer {self.hub.token}"
        ):
            return self._json({"error": "no"}, 401)
        for pattern, method in (
            (r"/api/datasets", self._list),
            (r"/api/repos/create", self._create),
            (r"/api/datasets/([^/]+/[^/]+)/preupload/(.+)", self._preupload),
            (r"/api/datasets/([^/]+/[^/]+)/commit/(.+)", self._commit),
            (r"/api/datasets/([^/]+/[^/]+)/tree/([^/]+)/?(.*)", self._tree),
            (r"/api/datasets/([^/]+/[^/]+)(?:/revision/(.+))?", self._info),
            (r"/datasets/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", self._resolve),
        ):
            match = re.fullmatch(pattern, path)
            if match:
                return method(body, query, *match.groups())
        return self._json({"error": f"unknown {path}"}, 404)

    def _list(self, body: bytes, query: dict[str, list[str]]) -> None:
        author, wanted = query.get("author", [""])[0], query.get("search", [""])[0]
        names = [name for name in self.hub.repositories if name.startswith(f"{author}/") and wanted in name]
        self._json([{"id": name, "private": False, "tags": [], "downloads": 0, "likes": 0} for name in names])

    def _create(self, body: bytes, query: dict[str, list[str]]) -> None:
        asked = json.loads(body)
        name = f"{asked['organization']}/{asked['name']}"
        existed = name in self.hub.repositories
        if not existed:
            self.hub.commit(name, {".gitattributes": b""})
        url = f"{self.hub.url}/datasets/{name}"
        self._json({"url": url, "name": name, "id": name}, 409 if existed else 200)

    def _preupload(self, body: bytes, query: dict[str, list[str]], name: str, revision: str) -> None:
        files = [{"path": file["path"], "uploadMode": "regular"} for file in json.loads(body)["files"]]
        self._json({"files": [{**file, "shouldIgnore": False, "oid": None} for file in files]})

    def _commit(self, body: bytes, query: dict[str, list[str]], name: str, revision: str) -> None:
        lines = [json.loads(line) for line in body.splitlines()]
        changes = {
            line["value"]["path"]: base64.b64decode(line["value"]["content"]) for line in lines if line["key"] == "file"
        }
        commit = self.hub.commit(name, changes)
        self._json({"commitUrl": f"{self.hub.url}/datasets/{name}/commit/{commit}", "commitOid": commit})

    def _info(self, body: bytes, query: dict[str, list[str]], name: str, revision: str | None) -> None:
        found = self._found(name, revision or "main")
        if found is not None:
            siblings = [{"rfilename": path} for path in found[1]]
            self._json({"id": name, "sha": found[0], "private": False, "tags": [], "siblings": siblings})

    def _tree(self, body: bytes, query: dict[str, list[str]], name: str, revision: str, folder: str) -> None:
        found = self._found(name, revision)
        if found is None:
            return
        start = f"{folder}/" if folder else ""
        files = {path: data for path, data in found[1].items() if path.startswith(start)}
        if folder and not files:
            return self._error("EntryNotFound")
        self._json([{"type": "file", "path": path, "size": len(data), "oid": "0" * 40} for path, data in files.items()])

    def _resolve(self, body: bytes, query: dict[str, list[str]], name: str, revision: str, path: str) -> None:
        found = self._found(name, revision)
        if found is None:
            return
        if path not in found[1]:
            return self._error("EntryNotFound", found[0])
        data = bytearray(found[1][path])
        etag = hashlib.sha1(data).hexdigest()
        if path in self.hub.flips:
            data[self.hub.flips[path]] ^= 1
        match = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        first = int(match.group(1)) if match and self.hub.ranges else 0
        headers = {"ETag": f'"{etag}"', "X-Repo-Commit": found[0], "Accept-Ranges": "bytes"}
        if first:
            headers["Content-Range"] = f"bytes {first}-{len(data) - 1}/{len(data)}"
        cuts = self.hub.cuts.get(path)
        cut = cuts.pop(0) if cuts and self.command == "GET" else None
        self._send(206 if first else 200, bytes(data[first:]), headers, cut)

    def _found(self, name: str, revision: str) -> tuple[str, Files] | None:
        if name not in self.hub.repositories:
            self._error("RepoNotFound")
            return None
        found = self.hub.at(name, revision)
        if found is None:
            self._error("RevisionNotFound")
        return found

    def _error(self, code: str, commit: str = "") -> None:
        headers = {"X-Error-Code": code, "X-Error-Message": code, **({"X-Repo-Commit": commit} if commit else {})}
        self._send(404, json.dumps({"error": code}).encode(), headers)

    def _json(self, content: object, status: int = 200) -> None:
        self._send(status, json.dumps(content).encode(), {"Content-Type": "application/json"})

    def _send(self, status: int, content: bytes, headers: dict[str, str], cut: int | None = None) -> None:
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content if cut is None else content[:cut])
        if cut is not None:
            self.wfile.flush()
            self.close_connection = True


@contextmanager
def stand_in_hub() -> Iterator[Hub]:
    """Serves an empty hub on a free port of 127.0.0.1."""
    hub = Hub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
