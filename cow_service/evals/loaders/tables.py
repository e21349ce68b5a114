"""Questions in a file of one's own: JSON Lines, CSV, TSV with base64 pictures (as VLMEvalKit has them), or Parquet."""

from __future__ import annotations

import base64
import binascii
import csv
import difflib
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from cow_service.evals.loaders.parquet import parquet_rows
from cow_service.evals.loaders.rows import FileFault, Row, RowFault
from cow_service.evals.wording import LETTERS

# What a column means, by its names; those of VLMEvalKit are among them.
COLUMNS: dict[str, tuple[str, ...]] = {
    "id": ("id", "index"),
    "image": ("image", "image_path"),
    "question": ("question",),
    "options": ("options", "choices"),
    "answer": ("answer",),
    "task": ("task", "category", "type"),
    "level": ("level", "difficulty"),
    "scene": ("scene",),
}
IGNORED = ("split", "l2-category", "source", "meta", "not_sure", "hint")
REQUIRED = ("image", "question", "answer")
_URL = ("http://", "https://")
_NAMES = {name: column for column, names in COLUMNS.items() for name in names}
_LONGEST_PATH = 1024  # characters; what is longer is base64

Numbered = tuple[str, dict[str, Any]] | RowFault  # where a row stands, and its fields; or why it has none


def table_rows(path: Path, *, ignore_columns: bool = False) -> Iterator[Row | RowFault]:
    """The rows of a file. Columns that mean nothing are faults, unless they are ignored."""
    told: set[str] = set()
    try:
        for numbered in READERS[path.suffix.lower()](path):
            if isinstance(numbered, RowFault):
                yield numbered
                continue
            place, fields = numbered
            unknown = [name for name in fields if not _is_known(name)]
            if unknown and not ignore_columns:
                for name in (name for name in unknown if name not in told):
                    told.add(name)
                    yield RowFault(f"{place}: {_unknown(name)}")
                continue
            yield _row(path, place, fields)
    except RowFault as fault:
        yield fault


def _is_known(name: str) -> bool:
    return name in _NAMES or name in IGNORED or (len(name) == 1 and name in LETTERS)


def _unknown(name: str) -> str:
    close = difflib.get_close_matches(name, _NAMES, 1)
    hint = f"did you mean `{close[0]}`?" if close else f"known are {', '.join(COLUMNS)}, and A, B, C... for options."
    return f"unknown column `{name}`: {hint}"


def _row(path: Path, place: str, fields: dict[str, Any]) -> Row | RowFault:
    values = {_NAMES[name]: value for name, value in fields.items() if name in _NAMES and value not in (None, "")}
    missing = [name for name in REQUIRED if name not in values]
    if missing:
        return RowFault(f"{place}: has no {' and no '.join(f'`{name}`' for name in missing)}")
    try:
        image = _image(values["image"], path.parent)
        options = _options(values.get("options"), fields)
    except RowFault as fault:
        return RowFault(f"{place}: {fault}")
    named = str(values.get("id", place.rpartition(" ")[2]))
    return Row(
        place=place,
        id=named,
        source_id=named,
        image=image,
        question=str(values["question"]),
        answer=str(values["answer"]),
        options=options,
        task=None if values.get("task") is None else str(values["task"]),
        level=None if values.get("level") is None else str(values["level"]),
        scene=None if values.get("scene") is None else str(values["scene"]),
    )


def _options(given: Any, fields: dict[str, Any]) -> list[str] | None:
    """Those of the row: a list, its JSON, or columns A, B, C...; None where the question lists them."""
    if isinstance(given, str):
        try:
            given = json.loads(given)
        except ValueError as error:
            raise RowFault(f'`options` must be a JSON list such as ["Yes", "No"], got {given[:60]!r}') from error
    if given is not None:
        if not isinstance(given, list):
            raise RowFault(f"`options` must be a list, got {type(given).__name__}")
        return [str(text) for text in given]
    filled = [letter for letter in LETTERS if fields.get(letter) not in (None, "")]
    if "".join(filled) != LETTERS[: len(filled)]:
        raise RowFault(f"the options {', '.join(filled)} leave a letter out")
    return [str(fields[letter]) for letter in filled] or None


def _image(given: Any, folder: Path) -> bytes:
    """The bytes of a picture: a file beside the table, base64, a data URL, or the bytes themselves."""
    if isinstance(given, dict):  # as the Hugging Face libraries keep pictures
        given = given.get("bytes") or given.get("path")
    if isinstance(given, bytes):
        return given
    if not isinstance(given, str):
        raise RowFault(f"`image` must be a file or base64, got {type(given).__name__}")
    if given.startswith(_URL):
        raise RowFault(f"`image` must not be an address ({given[:60]}): download it, and name the file")
    if len(given) <= _LONGEST_PATH and not given.startswith("data:"):
        file = folder / given
        if file.is_file():
            return file.read_bytes()
        if "." in given:  # which base64 has not
            raise RowFault(f"the image {given!r} is not there: a path starts at the folder of the table")
    text = given.partition(",")[2] if given.startswith("data:") else given
    try:
        return base64.b64decode("".join(text.split()), validate=True)
    except (binascii.Error, ValueError) as error:
        raise RowFault(f"`image` is no file and no whole base64: {given[:40]!r}... ({error})") from error


def _json_lines(path: Path) -> Iterator[Numbered]:
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        if not line.strip():
            continue
        place = f"{path.name}, line {number}"
        try:
            fields = json.loads(line)
        except ValueError as error:
            yield RowFault(f"{place}: no JSON ({error}); was the file written to its end?")
            continue
        if isinstance(fields, dict):
            yield place, fields
        else:
            yield RowFault(f"{place}: must be an object, got {type(fields).__name__}")


def _separated(delimiter: str) -> Callable[[Path], Iterator[Numbered]]:
    def rows(path: Path) -> Iterator[Numbered]:
        csv.field_size_limit(sys.maxsize)  # a field may hold a picture
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, delimiter=delimiter, strict=True)
            yield from _numbered(path, reader)

    return rows


def _numbered(path: Path, reader: Iterable[list[str]]) -> Iterator[Numbered]:
    names: list[str] = []
    number = 0
    try:
        for number, cells in enumerate(reader, 1):
            if not names:
                names = [name.strip() for name in cells]
                continue
            if cells and len(cells) != len(names):
                yield RowFault(
                    f"{path.name}, row {number}: has {len(cells)} cells for {len(names)} columns; was the file written "
                    "to its end?"
                )
            elif cells:
                yield f"{path.name}, row {number}", dict(zip(names, cells, strict=True))
    except (csv.Error, UnicodeDecodeError) as error:
        raise FileFault(f"{path.name}, row {number + 1}: {error}; was the file written to its end?") from error


def _parquet(path: Path) -> Iterator[Numbered]:
    for number, fields in enumerate(parquet_rows(path)):
        yield f"{path.name}, row {number}", fields


READERS: dict[str, Callable[[Path], Iterator[Numbered]]] = {
    ".jsonl": _json_lines,
    ".csv": _separated(","),
    ".tsv": _separated("\t"),
    ".parquet": _parquet,
}
