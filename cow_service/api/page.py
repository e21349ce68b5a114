"""`GET /`: the page for people, its modules and its example pictures, as they lie in the package."""

from __future__ import annotations

import gzip
import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from urllib.parse import urlsplit

from fastapi import APIRouter, Request, Response
from PIL import Image

from cow_service.errors import NotFound
from cow_service.media.artifacts import ArtifactStore
from cow_service.weights.manifests import EXAMPLES

MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
PRELOADS = "<!-- preloads -->"  # in the page: the place for its modules, which it would find one after another
SIGNED_SECONDS = 60  # of a URL that is signed only to learn where the object store is
THUMBNAIL_SIDE = 400  # px
ANY_DIGEST = "0" * 64


@dataclass(frozen=True)
class StaticFile:
    """One file as it is sent."""

    body: bytes
    media_type: str

    @property
    def etag(self) -> str:
        """Of its bytes; weak, since it is the same for the compressed ones."""
        return f'W/"{hashlib.sha256(self.body).hexdigest()[:32]}"'

    @property
    def compresses(self) -> bool:
        """Whether it is text."""
        return not self.media_type.startswith("image/jpeg")


@cache
def static_files() -> dict[str, StaticFile]:
    """The page's files by their paths below `/web/`; the page itself is `index.html`."""
    found = dict(_files_in(files("cow_service").joinpath("web"), ""))
    modules = [path for path in sorted(found) if path.endswith(".js") and not path.startswith("docs/")]
    links = "\n".join(f'    <link rel="modulepreload" href="web/{path}">' for path in modules)
    page = found["index.html"]
    found["index.html"] = StaticFile(page.body.replace(PRELOADS.encode(), links.encode()), page.media_type)
    for name, example in EXAMPLES.items():
        image = example.file("image").read_bytes()
        found[f"examples/{name}.jpg"] = StaticFile(image, MEDIA_TYPES[".jpg"])
        found[f"examples/{name}-small.jpg"] = StaticFile(_thumbnail(image), MEDIA_TYPES[".jpg"])
    return found


def _thumbnail(image: bytes) -> bytes:
    """A JPEG of at most `THUMBNAIL_SIDE` px."""
    with Image.open(io.BytesIO(image)) as opened:
        opened.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
        out = io.BytesIO()
        opened.save(out, "JPEG", quality=75, optimize=True)
    return out.getvalue()


def _files_in(folder: Traversable, prefix: str) -> list[tuple[str, StaticFile]]:
    found: list[tuple[str, StaticFile]] = []
    for entry in folder.iterdir():
        if entry.is_dir():
            found += _files_in(entry, f"{prefix}{entry.name}/")
        elif (media_type := MEDIA_TYPES.get("." + entry.name.rpartition(".")[2])) is not None:
            found.append((prefix + entry.name, StaticFile(entry.read_bytes(), media_type)))
    return found


@cache
def _compressed(path: str) -> bytes:
    return gzip.compress(static_files()[path].body, mtime=0)


def _takes_gzip(accepted: str) -> bool:
    """Whether `Accept-Encoding` lists gzip, and not with a weight of nought (RFC 9110, section 12.5.3)."""
    for item in accepted.lower().split(","):
        name, _, weight = item.partition(";")
        if name.strip() == "gzip":
            return weight.replace(" ", "") not in ("q=0", "q=0.0", "q=0.00", "q=0.000")
    return False


def security_headers(artifacts_at: str | None = None) -> dict[str, str]:
    """Headers of the page: nothing from elsewhere, no inline script, no markup out of text.

    `artifacts_at` is the origin of an object store to which the server sends callers for pictures and videos.
    """
    store = f" {artifacts_at}" if artifacts_at else ""
    policy = (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        f"img-src 'self' blob: data:{store}",
        f"media-src 'self' blob:{store}",
        f"connect-src 'self'{store}",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
        "trusted-types 'none'",
    )
    return {
        "Content-Security-Policy": "; ".join(policy),
        "Cross-Origin-Opener-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
    }


def page_routes(store: Callable[[], ArtifactStore], redirects: bool) -> APIRouter:
    """The routes. `redirects`: callers are sent to the store for artifacts, where it can sign URLs."""
    router = APIRouter(include_in_schema=False)

    @cache
    def headers() -> dict[str, str]:
        url = store().signed_url(ANY_DIGEST, SIGNED_SECONDS) if redirects else None
        parts = None if url is None else urlsplit(url)
        return security_headers(None if parts is None else f"{parts.scheme}://{parts.netloc}")

    @router.head("/")
    @router.get("/")
    def page(request: Request) -> Response:
        return _respond(request, "index.html", headers())

    @router.head("/web/{path:path}")
    @router.get("/web/{path:path}")
    def web(request: Request, path: str) -> Response:
        if path not in static_files() or path == "index.html":
            raise NotFound(f"The page has no file /web/{path[:200]}.")
        return _respond(request, path, headers())

    return router


def _respond(request: Request, path: str, headers: dict[str, str]) -> Response:
    """A file, compressed where the caller takes that. Always asked for again: a new version is seen at once."""
    found = static_files()[path]
    sent = headers | {"ETag": found.etag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    if found.etag.removeprefix("W/") in known or "*" in known:
        return Response(status_code=304, headers=sent)
    if found.compresses and _takes_gzip(request.headers.get("accept-encoding", "")):
        return Response(_compressed(path), headers=sent | {"Content-Encoding": "gzip"}, media_type=found.media_type)
    return Response(found.body, headers=sent, media_type=found.media_type)
