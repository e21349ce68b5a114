"""Verifies a made set: files, rows, pictures, answers against the truth records, balance of answers."""

import io
import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from PIL import Image, UnidentifiedImageError

from .card import digest, set_files
from .errors import UsageError
from .plan import SUBSET_OF

BALANCE = (0.35, 0.65)
BALANCE_FROM = 12
"""Yes/No items per subset and level from which on their balance is checked."""
PICTURES = {1: ("clean.jpg", "ids.png"), 2: ("clean.jpg", "background.jpg", "ids.png", "depth.png")}
"""Pictures of a truth folder, apart from `image.jpg` and the future, by the manifest's format.

Sets of format 1 may have `background.jpg`: it was added without a new number.
"""


@dataclass
class Report:
    """What was found: `problems` in words, `answers` by (subset, level, option's text)."""

    problems: list[str] = field(default_factory=list)
    answers: Counter = field(default_factory=Counter)
    ids: list[str] = field(default_factory=list)


def first_touched(meta: dict) -> str | None:
    """What the mover touches first after t = 0, the floor included."""
    for contact in meta["contacts"]:
        if meta["object"] in {contact["a"], contact["b"]}:
            return contact["b"] if contact["a"] == meta["object"] else contact["a"]
    return None


def expected_answer(meta: dict) -> str:
    """The option's text that the record of the motion leads to."""
    form, target = meta["form"], meta["target"]
    if form == "first":
        return min(meta["hits"], key=lambda name: meta["hits"][name])
    if form == "slide-occlude":
        yes = meta["hidden"] >= 0.3
    elif form == "billiards":
        yes = meta["chain"]["hit"] is not None
    elif form == "fall":
        yes = first_touched(meta) == target
    elif form == "place":
        yes = meta["world"][meta["object"]][-1][2] < meta["fit"]["rim"]
    else:
        yes = target in meta["hits"]
    return "Yes" if yes else "No"


def check_picture(data: bytes, size: list[int]) -> str | None:
    """What is wrong with a picture, or None."""
    try:
        with Image.open(io.BytesIO(data)) as picture:
            picture.load()
            return None if list(picture.size) == size else f"the picture is {picture.size}, not {size}"
    except (OSError, UnidentifiedImageError) as error:
        return f"the picture does not decode ({error})"


def check_depth(folder: Path) -> str | None:
    """What is wrong with the depth of a truth folder, or None."""
    with Image.open(folder / "depth.png") as depth, Image.open(folder / "ids.png") as ids:
        if depth.mode != "I;16":
            return f"depth.png has the mode {depth.mode}, not 16-bit grey"
        unknown = (np.asarray(ids) > 0) & (np.asarray(depth) == 0)
    return f"depth.png is 0 at {unknown.sum()} pixels of objects" if unknown.any() else None


def check_pictures(folder: Path, names: list[str], size: list[int]) -> str | None:
    """The first thing that is wrong with the pictures of a truth folder, or None."""
    for name in names:
        wrong = check_picture((folder / name).read_bytes(), size)
        if wrong:
            return f"{name}: {wrong}"
    return check_depth(folder) if "depth.png" in names else None


def check_row(row: dict, folder: Path, pictures: tuple[str, ...], report: Report) -> None:
    """One row against its truth folder."""
    path = folder / row["id"] / "meta.json"
    if not path.exists():
        report.problems.append(f"{row['id']}: {path} is missing")
        return
    meta = json.loads(path.read_text())
    names = ["image.jpg", *pictures, *(f"future_{n}.jpg" for n in meta["future"])]
    missing = [name for name in names if not (path.parent / name).exists()]
    if missing:
        report.problems.append(f"{row['id']}: {', '.join(missing)} missing")
        return
    found = check_pictures(path.parent, names, meta["image_size"])
    told = meta["options"][ord(meta["answer"]) - ord("A")]
    tests = {
        "the id differs from meta.json's": meta["id"] == row["id"],
        "the answer differs from meta.json's": row["answer"] == f"({meta['answer']})",
        "the abstaining option differs from meta.json's": row["not_sure"] == f"({meta['not_sure']})",
        "the question differs from meta.json's": row["question"] == meta["question"],
        "the picture differs from image.jpg": row["image"]["bytes"] == (path.parent / "image.jpg").read_bytes(),
        "the answer contradicts the motion": told == expected_answer(meta),
        "the options are not in the question": all(f") {o}" in row["question"] for o in meta["options"]),
    }
    report.problems += [f"{row['id']}: {text}" for text, good in tests.items() if not good]
    if found:
        report.problems.append(f"{row['id']}: {found}")
    report.answers[folder.name, meta["level"], told if told in {"Yes", "No"} else f"option {meta['answer']}"] += 1


def check_manifest(out: Path, report: Report) -> None:
    """Every file against its SHA-256."""
    told = json.loads((out / "manifest.json").read_text())["files"]
    there = {str(p.relative_to(out)): p for p in set_files(out)}
    for name in sorted(told.keys() | there.keys()):
        if name not in there:
            report.problems.append(f"{name}: is in the manifest and missing")
        elif name not in told:
            report.problems.append(f"{name}: is not in the manifest")
        elif digest(there[name]) != told[name]["sha256"]:
            report.problems.append(f"{name}: its SHA-256 differs from the manifest's")


def check_balance(report: Report) -> None:
    """Yes and No are about as frequent in every subset and level."""
    for subset, level in sorted({(s, lv) for s, lv, _ in report.answers}):
        yes, no = report.answers[subset, level, "Yes"], report.answers[subset, level, "No"]
        if yes + no >= BALANCE_FROM and not BALANCE[0] <= yes / (yes + no) <= BALANCE[1]:
            report.problems.append(f"{subset} {level}: {yes} Yes and {no} No are out of balance")


def check_set(out: Path) -> Report:
    """Everything about a set. Raises UsageError if there is none, or one of a format that is not known."""
    if not (out / "manifest.json").exists():
        raise UsageError(f"{out} holds no finished set (no manifest.json); run `cow-scenes make` first")
    made_as = json.loads((out / "manifest.json").read_text())["format"]
    if made_as not in PICTURES:
        raise UsageError(f"{out} has format {made_as}; this version knows {', '.join(map(str, PICTURES))}")
    report = Report()
    for subset in SUBSET_OF.values():
        for shard in sorted((out / subset).glob("*.parquet")):
            for row in pq.read_table(shard).to_pylist():
                report.ids.append(row["id"])
                check_row(row, out / "truth" / subset, PICTURES[made_as], report)
    twice = [name for name, count in Counter(report.ids).items() if count > 1]
    report.problems += [f"{name}: stands {report.ids.count(name)} times" for name in twice]
    check_manifest(out, report)
    check_balance(report)
    return report
