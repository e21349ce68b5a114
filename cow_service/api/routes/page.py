"""`GET /`, the page for people, and `GET /docs`, Swagger UI, with their files. They do not belong to the contract."""

import gzip
import hashlib
import io
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from urllib.parse import urlsplit

from fastapi import APIRouter, Request, Response
from PIL import Image

from cow_service.api.submission import Engine
from cow_service.errors import NotFound
from cow_service.jobs.engine import JobEngine
from cow_service.media.artifacts import ArtifactStore
from cow_service.weights.manifests import EXAMPLES, FILMS

WEB = Path(__file__).parents[2] / "web"
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".mp4": "video/mp4",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".wasm": "application/wasm",
}
ENGINE = "vendor/rapier"  # moves the world while you drag; loaded at that moment
PRELOADS = "<!-- preloads -->"  # in the page: the place for its modules, which it would find one after another
SIGNED_SECONDS = 60  # of a URL that is signed only to learn where the object store is
THUMBNAIL_SIDE = 400  # px
ANY_DIGEST = "0" * 64
NO_GZIP = ("q=0", "q=0.0", "q=0.00", "q=0.000")

HEADERS = {
    "Cache-Control": "no-cache",  # asked for again, and answered 304: a new version is seen at once
    "Referrer-Policy": "no-referrer",
    "Vary": "Accept-Encoding",
    "X-Content-Type-Options": "nosniff",
}
# Nothing from elsewhere, and no inline script.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; "
)
# Swagger UI draws its signs as `data:` pictures, and shows a picture that it got as `blob:`. It sets styles by script,
# which needs no `unsafe-inline`.
DOCS_HEADERS = HEADERS | {"Content-Security-Policy": POLICY + "img-src 'self' data: blob:; connect-src 'self'"}

router = APIRouter(include_in_schema=False)


@router.api_route("/", methods=["GET", "HEAD"])
def page(request: Request, engine: Engine) -> Response:
    """The page for people."""
    return _send_web_file(request, engine, "index.html")


@router.api_route("/web/{path:path}", methods=["GET", "HEAD"])
def web_file(request: Request, engine: Engine, path: str) -> Response:
    """A file of that page."""
    if path not in static_files() or path == "index.html":
        raise NotFound(f"The page has no file /web/{path[:200]}.")
    return _send_web_file(request, engine, path)


@router.api_route("/docs", methods=["GET", "HEAD"])
def docs(request: Request) -> Response:
    """Swagger UI."""
    return _send(request, docs_files()["index.html"], DOCS_HEADERS)


@router.api_route("/docs/{name}", methods=["GET", "HEAD"])
def docs_file(request: Request, name: str) -> Response:
    """A file of Swagger UI."""
    if name not in docs_files() or name == "index.html":  # not the page: its addresses are relative to /docs
        raise NotFound("There is no such file. The documentation is at /docs.")
    return _send(request, docs_files()[name], DOCS_HEADERS)


@dataclass(frozen=True)
class StaticFile:
    """One file, ready to send."""

    body: bytes
    media_type: str

    @cached_property
    def etag(self) -> str:
        """Of its bytes; weak, since it is the same for the compressed ones."""
        return f'W/"{hashlib.sha256(self.body).hexdigest()[:32]}"'

    @cached_property
    def compressed(self) -> bytes:
        """Its bytes, compressed by gzip."""
        return gzip.compress(self.body, mtime=0)


@cache
def static_files() -> dict[str, StaticFile]:
    """The page's files by their paths below `/web/`; the page itself is `index.html`."""
    found = _files_in(WEB)
    late = ("docs/", "live/", ENGINE)
    modules = [path for path in sorted(found) if path.endswith(".js") and not path.startswith(late)]
    links = "\n".join(f'    <link rel="modulepreload" href="web/{path}">' for path in modules)
    page = found["index.html"]
    found["index.html"] = StaticFile(page.body.replace(PRELOADS.encode(), links.encode()), page.media_type)
    wasm = (WEB / f"{ENGINE}.wasm.gz").read_bytes()
    found[f"{ENGINE}.wasm"] = StaticFile(gzip.decompress(wasm), MEDIA_TYPES[".wasm"])
    for name, example in EXAMPLES.items():
        image, small = example.file("image").read_bytes(), io.BytesIO()
        with Image.open(io.BytesIO(image)) as opened:
            opened.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
            opened.save(small, "JPEG", quality=75, optimize=True)
        found[f"examples/{name}.jpg"] = StaticFile(image, MEDIA_TYPES[".jpg"])
        found[f"examples/{name}.mp4"] = StaticFile(FILMS[name].file("film").read_bytes(), MEDIA_TYPES[".mp4"])
        found[f"examples/{name}-small.jpg"] = StaticFile(small.getvalue(), MEDIA_TYPES[".jpg"])
    return found


@cache
def docs_files() -> dict[str, StaticFile]:
    """The page of `/docs` and what it loads, 1.7 MB, by name; read on first use."""
    found, swagger_ui = _files_in(WEB / "docs"), files("fastapi_offline").joinpath("static")
    for name in ("swagger-ui-bundle.js", "swagger-ui.css"):
        found[name] = StaticFile(swagger_ui.joinpath(name).read_bytes(), MEDIA_TYPES[Path(name).suffix])
    return found


def _files_in(folder: Path) -> dict[str, StaticFile]:
    return {
        path.relative_to(folder).as_posix(): StaticFile(path.read_bytes(), MEDIA_TYPES[path.suffix])
        for path in folder.rglob("*")
        if path.suffix in MEDIA_TYPES
    }


@cache
def page_headers(artifacts: ArtifactStore, redirects: bool) -> dict[str, str]:
    """Headers of the page: nothing from elsewhere but artifacts, no inline script, no markup out of text.

    `redirects`: callers are sent to the store for artifacts, where it can sign URLs.
    """
    store = ""
    if redirects and (url := artifacts.signed_url(ANY_DIGEST, SIGNED_SECONDS)) is not None:
        parts = urlsplit(url)
        store = f" {parts.scheme}://{parts.netloc}"
    policy = POLICY.replace("script-src 'self'", "script-src 'self' 'wasm-unsafe-eval'")
    policy = (
        f"{policy}img-src 'self' blob: data:{store}; media-src 'self' blob:{store}; connect-src 'self'{store}; "
        "require-trusted-types-for 'script'; trusted-types 'none'"
    )
    own = {"Cross-Origin-Opener-Policy": "same-origin", "X-Frame-Options": "DENY"}
    return HEADERS | own | {"Content-Security-Policy": policy}


def is_known(request: Request, etag: str) -> bool:
    """Whether the caller has the content of that tag (RFC 9110, section 13.1.2)."""
    known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return etag.removeprefix("W/") in known or "*" in known


def _send_web_file(request: Request, engine: JobEngine, path: str) -> Response:
    if not path.endswith((".html", ".svg")):  # the policy is that of documents
        return _send(request, static_files()[path], HEADERS)
    service = engine.service
    return _send(request, static_files()[path], page_headers(service.artifacts, service.settings.artifacts_redirect))


def _send(request: Request, file: StaticFile, headers: dict[str, str]) -> Response:
    """A file, compressed where the caller takes that."""
    headers = headers | {"ETag": file.etag}
    if is_known(request, file.etag):
        return Response(status_code=304, headers=headers)
    # Not with a weight of nought (RFC 9110, section 12.5.3).
    accepted = (item.partition(";") for item in request.headers.get("accept-encoding", "").lower().split(","))
    gzips = any(name.strip() == "gzip" and weight.replace(" ", "") not in NO_GZIP for name, _, weight in accepted)
    if gzips and file.media_type not in (MEDIA_TYPES[".jpg"], MEDIA_TYPES[".mp4"]):
        return Response(file.compressed, headers=headers | {"Content-Encoding": "gzip"}, media_type=file.media_type)
    return Response(file.body, headers=headers, media_type=file.media_type)
