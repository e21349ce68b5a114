"""A server in a thread that speaks as much of the Hugging Face hub's HTTP API as pulling weights needs.

Small files come from the hub itself; large ones (`lfs`) by a redirect to another host, as the real hub sends them.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit


@dataclass(frozen=True)
class Blob:
    """A file of a repository."""

    data: bytes
    lfs: bool = True
    listed_size: int | None = None  # what the listing says, where it lies

    @property
    def sha1(self) -> str:
        return hashlib.sha1(b"blob %d\0" % len(self.data) + self.data).hexdigest()

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.data).hexdigest()

    def listed(self, path: str) -> dict[str, Any]:
        size = len(self.data) if self.listed_size is None else self.listed_size
        entry: dict[str, Any] = {"rfilename": path, "size": size, "blobId": self.sha1}
        if self.lfs:
            entry["lfs"] = {"sha256": self.sha256, "size": size, "pointerSize": 130}
        return entry


@dataclass
class Hub:
    """What the server holds, what it is to do wrong, and what it was asked."""

    port: int = 0
    commits: dict[str, dict[str, dict[str, Blob]]] = field(default_factory=dict)  # repository, commit, path
    main: dict[str, str] = field(default_factory=dict)
    refused: dict[str, tuple[int, str]] = field(default_factory=dict)  # status and error code, by part of the address
    stall: dict[str, int] = field(default_factory=dict)  # bytes after which nothing more comes, by path
    stalled: threading.Event = field(default_factory=threading.Event)
    go_on: threading.Event = field(default_factory=threading.Event)
    spoilt: set[str] = field(default_factory=set)  # paths whose bytes differ from those listed
    asked: list[str] = field(default_factory=list)  # paths of the files whose bytes were asked for
    listings: list[str] = field(default_factory=list)  # revisions

    def downloads(self) -> list[str]:
        return list(self.asked)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def commit(self, repository: str, files: dict[str, Blob]) -> str:
        """A new commit of these files, to which `main` moves; returns its hash."""
        told = repr((self.main.get(repository), sorted((path, blob.sha1) for path, blob in files.items())))
        commit = hashlib.sha1(told.encode()).hexdigest()
        self.commits.setdefault(repository, {})[commit] = files
        self.main[repository] = commit
        return commit


class Handler(BaseHTTPRequestHandler):
    hub: Hub

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is printed."""

    def do_HEAD(self) -> None:
        self.answer(body=False)

    def do_GET(self) -> None:
        with suppress(ConnectionError):
            self.answer(body=True)

    def answer(self, *, body: bool) -> None:
        address = unquote(urlsplit(self.path).path)
        for part, (status, code) in self.hub.refused.items():
            if part in address:
                return self.send(status, {"X-Error-Code": code, "X-Error-Message": f"{code} it is"})
        if match := re.fullmatch(r"/api/(?:models|datasets)/([^/]+/[^/]+)(?:/revision/(.+))?", address):
            return self.list(match[1], match[2] or "main")
        if match := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)/tree/(.+)", address):
            return self.tree(match[1], match[2])
        if match := re.fullmatch(r"/(?:datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", address):
            return self.resolve(match[1], match[2], match[3], body=body)
        if match := re.fullmatch(r"/storage/([^/]+/[^/]+)/([^/]+)/(.+)", address):
            return self.bytes(self.hub.commits[match[1]][match[2]][match[3]], match[3], {}, body=body)
        return self.send(404, {})

    def list(self, repository: str, revision: str) -> None:
        if repository not in self.hub.commits:
            return self.send(401, {"X-Error-Code": "RepoNotFound", "X-Error-Message": "Repository not found"})
        commit = self.hub.main[repository] if revision == "main" else revision
        if commit not in self.hub.commits[repository]:
            return self.send(404, {"X-Error-Code": "RevisionNotFound"})
        self.hub.listings.append(revision)
        files = [blob.listed(path) for path, blob in self.hub.commits[repository][commit].items()]
        document = json.dumps({"id": repository, "sha": commit, "siblings": files}).encode()
        return self.send(200, {"Content-Type": "application/json"}, document)

    def tree(self, repository: str, commit: str) -> None:
        files = self.hub.commits[repository][commit]
        listed = [
            {"type": "file", "path": path, "size": len(blob.data), "oid": blob.sha1} for path, blob in files.items()
        ]
        return self.send(200, {"Content-Type": "application/json"}, json.dumps(listed).encode())

    def resolve(self, repository: str, commit: str, path: str, *, body: bool) -> None:
        blob = self.hub.commits[repository].get(commit, {}).get(path)
        if blob is None:
            return self.send(404, {"X-Error-Code": "EntryNotFound"})
        headers = {"X-Repo-Commit": commit, "ETag": f'"{blob.sha1}"'}
        if not blob.lfs:
            return self.bytes(blob, path, headers, body=body)
        headers |= {"X-Linked-Etag": f'"{blob.sha256}"', "X-Linked-Size": str(len(blob.data))}
        storage = f"http://localhost:{self.hub.port}/storage/{repository}/{commit}/{path}"
        return self.send(302, headers | {"Location": storage})

    def bytes(self, blob: Blob, path: str, headers: dict[str, str], *, body: bool) -> None:
        data = blob.data[::-1] if path in self.hub.spoilt else blob.data
        if not body:
            return self.send(200, headers | {"Content-Length": str(len(data))})
        self.hub.asked.append(path)
        cut = self.hub.stall.pop(path, None)
        self.send(200, headers, data, cut=cut)
        if cut is not None:
            self.wfile.flush()
            self.hub.stalled.set()
            self.hub.go_on.wait()
        return None

    def send(self, status: int, headers: dict[str, str], body: bytes = b"", *, cut: int | None = None) -> None:
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body[:cut])


@contextmanager
def running() -> Iterator[Hub]:
    """A hub at an address of its own."""
    hub = Hub()
    handler = type("HubHandler", (Handler,), {"hub": hub})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        hub.port = server.server_port
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield hub
        finally:
            hub.go_on.set()
            server.shutdown()
            thread.join()
