"""A Google Cloud Storage bucket on 127.0.0.1: listing, ranged reads and multipart uploads, as Minari's client asks."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit


@dataclass
class Bucket:
    """What the stand-in holds, does wrong and was asked.

    ``failures`` counts reads down: at zero every further read is refused.
    """

    url: str = ""
    name: str = "lab"
    blobs: dict[str, tuple[bytes, int]] = field(default_factory=dict)
    failures: int | None = None
    flips: dict[str, int] = field(default_factory=dict)
    ranges: list[str] = field(default_factory=list)

    def put(self, name: str, data: bytes) -> None:
        """Writes a blob, with a new generation."""
        self.blobs[name] = (data, self.blobs.get(name, (b"", 0))[1] + 1)

    def describe(self, name: str) -> dict[str, str]:
        """A blob's metadata."""
        data, generation = self.blobs[name]
        described = {"kind": "storage#object", "name": name, "bucket": self.name}
        return {**described, "size": str(len(data)), "generation": str(generation)}


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    bucket: Bucket

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        query = parse_qs(parts.query)
        if parts.path == f"/storage/v1/b/{self.bucket.name}/o":
            start = query.get("prefix", [""])[0]
            items = [self.bucket.describe(name) for name in self.bucket.blobs if name.startswith(start)]
            return self._send(200, json.dumps({"kind": "storage#objects", "items": items}).encode())
        match = re.fullmatch(rf"/download/storage/v1/b/{self.bucket.name}/o/(.+)", parts.path)
        name = unquote(match.group(1)) if match else ""
        if name not in self.bucket.blobs:
            return self._send(404, b"{}")
        if self.bucket.failures is not None:
            if self.bucket.failures == 0:
                return self._send(403, b"{}")
            self.bucket.failures -= 1
        data = bytearray(self.bucket.blobs[name][0])
        if name in self.bucket.flips:
            data[self.bucket.flips[name]] ^= 1
        asked = self.headers.get("Range", "")
        self.bucket.ranges.append(f"{name} {asked}")
        match = re.fullmatch(r"bytes=(\d+)-(\d+)", asked)
        if match is None:
            return self._send(200, bytes(data))
        first, last = (int(group) for group in match.groups())
        headers = {"Content-Range": f"bytes {first}-{min(last, len(data) - 1)}/{len(data)}"}
        return self._send(206, bytes(data[first : last + 1]), headers)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        boundary = self.headers["Content-Type"].split("boundary=")[1].strip('"').encode()
        _, described, content, _ = body.split(b"--" + boundary)
        name = json.loads(described.split(b"\r\n\r\n", 1)[1])["name"]
        self.bucket.put(name, content.split(b"\r\n\r\n", 1)[1].removesuffix(b"\r\n"))
        self._send(200, json.dumps(self.bucket.describe(name)).encode())

    def _send(self, status: int, content: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for key, value in {"Content-Type": "application/json", **(headers or {})}.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)


@contextmanager
def stand_in_bucket() -> Iterator[Bucket]:
    """Serves an empty bucket on a free port of 127.0.0.1."""
    bucket = Bucket()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"bucket": bucket}))
    server.daemon_threads = True
    bucket.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield bucket
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
