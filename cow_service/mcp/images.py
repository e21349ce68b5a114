"""An image as the caller of a tool names it: a file here, an address, the data itself, or one that is kept already."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from cow_service.client import ImageLike
from cow_service.errors import FieldError, InvalidRequest
from cow_service.media.artifacts import media_type_of
from cow_service.requests import ImageArtifact

ARTIFACTS = "cow://artifacts/"
_KEPT = "the 64-digit `image_sha256` of an earlier result, which asks about the same image again without sending it"
HELP_WITH_PATHS = f"The image: the absolute path of a PNG, JPEG or WebP file, a data URL, an http(s) URL, or {_KEPT}."
HELP_WITHOUT_PATHS = (
    f"The image (PNG, JPEG or WebP): a data URL (data:image/png;base64,...), an http(s) URL, or {_KEPT}. No path: this "
    "server does not read files."
)
_DIGEST = re.compile(rf"(?:{ARTIFACTS})?([0-9a-f]{{64}})", re.IGNORECASE | re.ASCII)
_SCHEME = re.compile(r"(data:|[a-z][a-z0-9+.-]*://)", re.IGNORECASE | re.ASCII)
_SENT_AS_IS = ("data:", "http://", "https://")
MAX_FILE_BYTES = 100_000_000  # servers take less
_SIGNATURE_BYTES = 12  # that tell what a file is
_MAX_SHOWN = 200  # characters of the caller's text in an error


def image_of(text: str, *, paths: bool) -> ImageLike:
    """What the SDK takes for an image; reads a file where it is one. `paths` says whether files may be named.

    Raises `InvalidRequest`, also for a file that is no image: nothing else leaves the machine.
    """
    text = text.strip()
    if digest := digest_of(text):
        return ImageArtifact(artifact=digest)
    scheme = found[0].lower() if (found := _SCHEME.match(text)) else None
    if scheme in _SENT_AS_IS:
        return scheme + text[len(scheme) :]
    if not paths:
        raise _wrong(
            f"{_shown(text)} is no data URL, http(s) URL or SHA-256 digest; files of the server's machine are not read"
        )
    if scheme not in (None, "file://"):
        raise _wrong(f"{_shown(text)} cannot be opened: give a path, a data URL, an http(s) URL or a digest")
    return _read(Path(url2pathname(urlsplit(text).path)) if scheme else Path(text))


def digest_of(text: str) -> str | None:
    """The SHA-256 that a text names, as such or as a resource; None where it names none."""
    found = _DIGEST.fullmatch(text)
    return found and found[1].lower()


def _read(path: Path) -> bytes:
    try:
        path = path.expanduser().absolute()
        if not path.is_file():  # devices and pipes may never end
            raise _wrong(f"there is no file {_shown(str(path))}; give an absolute path")
        with path.open("rb") as file:
            head = file.read(_SIGNATURE_BYTES)
            if media_type_of(head) not in ("image/png", "image/jpeg", "image/webp"):
                raise _wrong(f"{_shown(str(path))} is no PNG, JPEG or WebP")
            rest = file.read(MAX_FILE_BYTES)
            if len(head) + len(rest) > MAX_FILE_BYTES:
                raise _wrong(f"{_shown(str(path))} is larger than {MAX_FILE_BYTES // 1_000_000} MB")
            return head + rest
    except (OSError, RuntimeError, ValueError) as error:  # no home folder; NUL in the name
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise _wrong(f"{_shown(str(path))} cannot be read: {why or type(error).__name__}") from error


def _shown(text: str) -> str:
    return repr(text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}...")


def _wrong(detail: str) -> InvalidRequest:
    return InvalidRequest("The image cannot be used.", errors=(FieldError("/image", detail),))
