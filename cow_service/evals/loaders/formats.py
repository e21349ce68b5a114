"""The forms of data sets: CausalSpatial as published, scenes with truth, and JSON Lines, CSV, TSV or Parquet tables."""

import base64
import csv
import difflib
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from cow_service.errors import InvalidRequest
from cow_service.evals.items import LETTERS, REAL, Pictures, Truth
from cow_service.evals.loaders.rows import Collected, Known, Row, RowFault, Unread, collect

META, IMAGE, FUTURE = "meta.json", "image.jpg", "future_*.jpg"
SCENE_TEXTS = ("question", "answer", "task", "level")
SAMPLES_PER_SECOND = 30.0  # of scenes that do not say
Subset = Literal["collision", "physics", "compatibility", "occlusion", "realworld"]
SUBSETS: tuple[Subset, ...] = ("collision", "physics", "compatibility", "occlusion", "realworld")
TRUTH = "truth"  # of sets that are made with it
_LEVEL = re.compile(r"_Level_(\d+)")
_AT_ONCE = 64  # rows: a row may hold a picture of a megabyte
Fields = dict[str, Any]
Numbered = tuple[str, Fields | bytes]  # where a row stands, and its fields, or the text of a JSON object
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
_NAMES = {name: column for column, names in COLUMNS.items() for name in names}
_LONGEST_PATH = 1024  # characters; what is longer is base64


def scene_folders(folder: Path) -> list[Path]:
    """The folders of scenes, by name."""
    return sorted(path.parent for path in folder.glob(f"*/{META}"))


def scene_rows(folder: Path) -> Iterator[Unread]:
    """A row per scene."""
    for scene in scene_folders(folder):
        yield f"{scene.name}/{META}", partial(_scene_row, scene)


def _scene_row(scene: Path) -> Row:
    meta = _json_object((scene / META).read_bytes())
    _require(meta, ("question", "answer"))
    texts: Fields = {name: str(meta[name]) for name in SCENE_TEXTS if meta.get(name) not in (None, "")}
    named, image = str(meta.get("id") or scene.name), scene / IMAGE
    picture = image.read_bytes() if image.is_file() else None
    return Row(id=named, source_id=named, image=picture, scene=scene.name, truth=truth_of(scene, meta), **texts)


def truth_of(scene: Path, meta: Fields) -> Known | None:
    """What a scene's folder knows of what really happens; None if that is nothing.

    `future_12.jpg` shows sample 12; `fps` samples pass in a second. Raises `RowFault` for a track that is none.
    """
    try:
        fps, moved = meta.get("fps", SAMPLES_PER_SECOND), meta.get("object")
        numbered = [(int("".join(filter(str.isdigit, path.stem)) or 0), path) for path in scene.glob(FUTURE)]
        pictures = [(number / fps, path.read_bytes()) for number, path in sorted(numbered)]
        if not pictures and not meta.get("track"):
            return None
        # Of each object a box, or one per sample.
        boxes: Fields = {name: given for name, given in (meta.get("boxes") or {}).items() if given}
        sampled = {name: given for name, given in boxes.items() if isinstance(given[0], list)}
        sides = [math.sqrt(max((x1 - x0) * (y1 - y0), 1.0)) for x0, y0, x1, y1 in sampled.get(str(moved), ())]
        fields = {"fps": fps, "track": meta.get("track", ()), "scale": [side / sides[0] for side in sides]}
        fields |= {"object": moved, "boxes": boxes | {name: given[0] for name, given in sampled.items()}}
        truth = Truth.model_validate(fields)
    except (TypeError, ValueError, AttributeError, ZeroDivisionError, IndexError) as error:
        why = str(error).splitlines()[0]
        raise RowFault(f"`fps`, `track`, `boxes` or `object` cannot be used: {why}") from error
    if truth.scale and len(truth.scale) != len(truth.track):
        raise RowFault(f"`boxes` has {len(truth.scale)} of '{moved}' for {len(truth.track)} points of `track`")
    return Known(truth, pictures)


def table_rows(path: Path, *, ignore_columns: bool = False) -> Iterator[Unread]:
    """The rows of a file of one's own. Columns that mean nothing are faults, unless they are ignored."""
    for place, given in READERS[path.suffix.lower()](path):
        yield place, partial(_table_row, place, given, path.parent, ignore_columns)


def _table_row(place: str, given: Fields | bytes, folder: Path, ignore_columns: bool) -> Row:
    fields = _json_object(given) if isinstance(given, bytes) else given
    if isinstance(fields.get("meta"), dict):  # a batch's file has the answer there
        fields = {"answer": fields["meta"].get("answer")} | fields
    unknown = [name for name in fields if name not in (*_NAMES, *IGNORED, *LETTERS)]
    if unknown and not ignore_columns:
        close = difflib.get_close_matches(unknown[0], _NAMES, 1)
        known = f"known are {', '.join(COLUMNS)}, and A, B, C... for options"
        raise RowFault(f"unknown column `{unknown[0]}`: {f'did you mean `{close[0]}`?' if close else known}")
    values = {_NAMES[name]: value for name, value in fields.items() if name in _NAMES and value not in (None, "")}
    _require(values, ("image", "question", "answer"))
    image = _image(values.pop("image"), folder)
    options = _options(values.pop("options", None), fields)
    texts: Fields = {name: str(value) for name, value in values.items()}
    named = texts.pop("id", place.rpartition(" ")[2])
    return Row(id=named, source_id=named, image=image, options=options, **texts)


def _require(fields: Fields, names: Sequence[str]) -> None:
    missing = [name for name in names if fields.get(name) in (None, "")]
    if missing:
        raise RowFault(f"has no {' and no '.join(f'`{name}`' for name in missing)}")


def _options(given: Any, fields: Fields) -> list[str] | None:
    """Those of the row: a list, its JSON, or columns A, B, C...; None if the question lists them."""
    if given is not None:
        try:
            listed = json.loads(given) if isinstance(given, str) else given
        except ValueError:
            listed = None
        if not isinstance(listed, list):
            raise RowFault(f'`options` must be a list such as ["Yes", "No"], or its JSON, got {str(given)[:60]!r}')
        return [str(text) for text in listed]
    filled = [letter for letter in LETTERS if fields.get(letter) not in (None, "")]
    if "".join(filled) != LETTERS[: len(filled)]:
        raise RowFault(f"the options {', '.join(filled)} leave a letter out")
    return [str(fields[letter]) for letter in filled] or None


def _image(given: Any, folder: Path) -> bytes:
    """The bytes of a picture: a file in the folder of the table, base64, a data URL, or the bytes themselves."""
    if isinstance(given, dict):  # as the Hugging Face libraries keep pictures
        given = given.get("bytes") or given.get("path")
    if isinstance(given, bytes):
        return given
    if not isinstance(given, str):
        raise RowFault(f"`image` must be a file or base64, got {type(given).__name__}")
    if given.startswith(("http://", "https://")):
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
    except ValueError as error:
        raise RowFault(f"`image` is no file and no whole base64: {given[:40]!r}... ({error})") from error


def _json_object(text: bytes) -> Fields:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise RowFault(f"not complete JSON ({error}); was the file written to its end?") from error
    if not isinstance(found, dict):
        raise RowFault(f"must be an object, got {type(found).__name__}")
    return found


def _json_lines(path: Path) -> Iterator[Numbered]:
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        if line.strip():
            yield f"{path.name}, line {number}", line


def _separated(path: Path, delimiter: str) -> Iterator[Numbered]:
    csv.field_size_limit(sys.maxsize)  # a field may hold a picture
    number = 1
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, delimiter=delimiter, strict=True, restkey="", restval=None)
            for number, row in enumerate(rows, 2):
                if "" in row or None in row.values():
                    raise csv.Error("not as many cells as columns")
                yield f"{path.name}, row {number}", dict(row)
    except (csv.Error, UnicodeDecodeError) as error:
        raise InvalidRequest(f"{path.name}, row {number}: {error}; was the file written to its end?") from error


def _parquet_rows(path: Path, name: str) -> Iterator[tuple[str, Fields]]:
    """The rows of a file that is shown by this name. Raises `InvalidRequest` if it is none, or is not whole."""
    from pyarrow import ArrowException, parquet  # noqa: PLC0415

    try:
        with parquet.ParquetFile(path) as file:
            rows = (row for batch in file.iter_batches(batch_size=_AT_ONCE) for row in batch.to_pylist())
            for number, row in enumerate(rows):
                yield f"{name}, row {number}", row
    except (ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InvalidRequest(f"{name}: not a complete Parquet file ({reason}); download it again.") from error


READERS: dict[str, Callable[[Path], Iterator[Numbered]]] = {
    ".jsonl": _json_lines,
    ".csv": partial(_separated, delimiter=","),
    ".tsv": partial(_separated, delimiter="\t"),
    ".parquet": lambda path: _parquet_rows(path, path.name),
}


def subset_shards(folder: Path, subsets: Sequence[str]) -> dict[str, list[Path]]:
    """The Parquet files of each subset that the folder has."""
    found = {subset: sorted((folder / subset).glob("**/*.parquet")) for subset in subsets}
    return {subset: paths for subset, paths in found.items() if paths}


def load_causalspatial(folder: Path, subsets: Sequence[str], pictures: Pictures) -> Collected:
    """The items of a folder in the layout of the published data, or of sets made like it."""
    found = collect(_published_rows(folder, subsets), pictures, repeated_rows=True)
    made = [(item.id.partition("/")[0], item) for item in found.items if item.level != REAL]
    ids = Counter((subset, item.source_id) for subset, item in made)
    shared = Counter(subset for subset, item in made if ids[subset, item.source_id] > 1)
    without = Counter(subset for subset, item in made if item.abstain is None)
    found.notes[:0] = [
        *(
            f"{subset}: {count} rows share their id with others; items are identified by subset, shard and row."
            for subset, count in shared.items()
        ),
        *(f"{subset}: {count} rows have no option that abstains." for subset, count in without.items()),
    ]
    return found


def _published_rows(folder: Path, subsets: Sequence[str]) -> Iterator[Unread]:
    for subset, shards in subset_shards(folder, subsets).items():
        for shard, path in enumerate(shards):
            for number, (place, fields) in enumerate(_parquet_rows(path, path.relative_to(folder).as_posix())):
                yield place, partial(_published_row, folder, subset, f"{subset}/{shard}/{number}", fields)


def _published_row(folder: Path, subset: str, unique: str, fields: Fields) -> Row:
    """A row. One that lacks what the others have is a fault."""
    _require(fields, ("id", "question", "answer", "image"))
    source = str(fields["id"])
    level = _LEVEL.search(source)
    real = subset == "realworld"
    if level is None and not real:
        raise RowFault(f"the id {source[:60]!r} names no level: it should be like Collision_Level_1_0")
    image: Any = fields["image"]
    made = folder / TRUTH / subset / source
    return Row(
        id=unique,
        source_id=source,
        image=image.get("bytes") if isinstance(image, dict) else image if isinstance(image, bytes) else None,
        question=str(fields["question"]),
        answer=str(fields["answer"]),
        options=fields.get("options") or None,
        task=str(fields.get("type") or subset) if real else subset,
        level=REAL if real or level is None else f"L{level[1]}",
        truth=truth_of(made, _json_object((made / META).read_bytes())) if (made / META).is_file() else None,
    )
