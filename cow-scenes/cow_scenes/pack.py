"""Packs a made set into one file whose bytes depend on the set alone."""

import io
import json
import tarfile
import zipfile
from pathlib import Path

import zstandard

from .card import set_files
from .errors import UsageError

MOMENT = (2000, 1, 1, 0, 0, 0)
"""The time that every packed file carries."""


def tar_bytes(files: dict[str, bytes]) -> bytes:
    """A tar archive, compressed with Zstandard."""
    plain = io.BytesIO()
    with tarfile.open(fileobj=plain, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size, info.mode = len(data), 0o644
            archive.addfile(info, io.BytesIO(data))
    return zstandard.ZstdCompressor(level=19).compress(plain.getvalue())


def zip_bytes(files: dict[str, bytes]) -> bytes:
    """A zip archive."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in files.items():
            info = zipfile.ZipInfo(name, MOMENT)
            info.external_attr = 0o644 << 16
            archive.writestr(info, data, zipfile.ZIP_DEFLATED, 9)
    return packed.getvalue()


def pack_set(out: Path, file: Path, limit_mb: float) -> int:
    """Write the release file; its size in bytes.

    Raises:
        UsageError: if there is no finished set, the name's end is unknown, or the file would be too large.
    """
    manifest = out / "manifest.json"
    if not manifest.exists():
        raise UsageError(f"{out} holds no finished set (no manifest.json); run `cow-scenes make` first")
    packers = {".tar.zst": tar_bytes, ".zip": zip_bytes}
    packer = next((p for end, p in packers.items() if file.name.endswith(end)), None)
    if packer is None:
        raise UsageError(f"{file} ends neither in .tar.zst nor in .zip; give such a name")
    told = set(json.loads(manifest.read_text())["files"])
    there = [p for p in set_files(out) if str(p.relative_to(out)) in told]
    if len(there) != len(told):
        raise UsageError(f"{out} lacks {len(told) - len(there)} files of its manifest; run `cow-scenes check {out}`")
    data = packer({str(p.relative_to(out)): p.read_bytes() for p in [manifest, *there]})
    if len(data) > limit_mb * 1e6:
        raise UsageError(
            f"{file} would have {len(data) / 1e6:.1f} MB, more than --limit-mb {limit_mb:g}; make fewer items, "
            "a lower --quality or smaller pictures"
        )
    partial = file.with_name(f".{file.name}.part")
    partial.write_bytes(data)
    partial.replace(file)
    return len(data)
