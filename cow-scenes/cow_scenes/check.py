"""Verifies a made set: files, rows, pictures, answers against the truth records, balance of answers."""

import io
import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow.parquet as pq
from PIL import Image, UnidentifiedImageError

from .card import digest, set_files
from .errors import UsageError
from .plan import SUBSET_OF

BALANCE = (0.35, 0.65)
BALANCE_FROM = 12
"""Yes/No items per subset and level from which on their balance is checked."""


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


def check_row(row: dict, folder: Path, report: Report) -> None:
    """One row against its truth folder."""
    path = folder / row["id"] / "meta.json"
    if not path.exists():
        report.problems.append(f"{row['id']}: {path} is missing")
        return
    meta = json.loads(path.read_text())
    found = check_picture(row["image"]["bytes"], meta["image_size"])
    for name in ("clean.jpg", "background.jpg", "ids.png", *(f"future_{n}.jpg" for n in meta["future"])):
        found = found or check_picture((path.parent / name).read_bytes(), meta["image_size"])
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
    """Everything about a set. Raises UsageError if there is none."""
    if not (out / "manifest.json").exists():
        raise UsageError(f"{out} holds no finished set (no manifest.json); run `cow-scenes make` first")
    report = Report()
    for subset in SUBSET_OF.values():
        for shard in sorted((out / subset).glob("*.parquet")):
            for row in pq.read_table(shard).to_pylist():
                report.ids.append(row["id"])
                check_row(row, out / "truth" / subset, report)
    twice = [name for name, count in Counter(report.ids).items() if count > 1]
    report.problems += [f"{name}: stands {report.ids.count(name)} times" for name in twice]
    check_manifest(out, report)
    check_balance(report)
    return report
