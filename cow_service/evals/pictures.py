"""Pictures of a run: files that are named by the digest of what they hold."""

from __future__ import annotations

import hashlib
from pathlib import Path

from cow_service.media.artifacts import extension_of, media_type_of
from cow_service.media.images import decode


class Pictures:
    """A folder of pictures. The same bytes are kept once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._known = {path.stem: path for path in folder.iterdir() if not path.name.startswith(".")}

    def add(self, data: bytes) -> str:
        """Keeps a picture; returns its digest. Raises what `decode` raises for what is none."""
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._known:
            decode(data)
            self._write(digest, data)
        return digest

    def add_made(self, data: bytes) -> str:
        """The same for a picture that the service made."""
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._known:
            self._write(digest, data)
        return digest

    def path(self, digest: str) -> Path:
        """The file of a picture. Raises `KeyError` for one that was not added."""
        return self._known[digest]

    def read(self, digest: str) -> bytes:
        """What a picture holds. Raises `KeyError` for one that was not added."""
        return self.path(digest).read_bytes()

    def _write(self, digest: str, data: bytes) -> None:
        path = self.folder / f"{digest}.{extension_of(media_type_of(data) or 'image/png')}"
        partial = path.with_name(f".{digest}.partial")
        partial.write_bytes(data)
        partial.replace(path)
        self._known[digest] = path
