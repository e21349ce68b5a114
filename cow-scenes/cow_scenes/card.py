"""The data set's card (`README.md`) and `manifest.json` of a made folder."""

import hashlib
import json
from pathlib import Path

from .plan import LEVELS
from .settings import Settings

TEXT = """# What-if questions with known truth

{count} items made with seed {seed}: {makers}. Columns as in the public
CausalSpatial data: `id`, `question`, `answer`, `image`, `not_sure`. The configuration `physics` holds the task that the
paper calls Trajectory. `truth/<configuration>/<id>/` holds what is known of each item: the picture without arrow or
trail (`clean.jpg`), the same without the mover and its shadow (`background.jpg`), object ids (`ids.png`), depth
(`depth.png`), the future at samples 12 and 36 (30 per second), and `meta.json`.

| configuration | level 1 | level 2 |
|---|---|---|
{table}

Licence of pictures and records: Apache-2.0. `manifest.json` has versions, arguments and a SHA-256 per file.
"""


MAKERS = {
    "first": "Bullet computed the motion, Blender's Cycles drew it",
    "other": "MuJoCo computed the motion and drew it, before photographs that are CC0 or in the public domain",
}


def card_of(settings: Settings) -> str:
    """The card with the configurations' front matter."""
    plan = settings.plan()
    subsets = sorted({key.subset for key in plan})
    lines = ["---", "license: apache-2.0", "task_categories:", "- visual-question-answering", "configs:"]
    for subset in subsets:
        lines += [f"- config_name: {subset}", "  data_files:", "  - split: test", f"    path: {subset}/test-*"]
    counts = {s: [sum(k.subset == s and k.level == lv for k in plan) for lv in LEVELS] for s in subsets}
    table = "\n".join(f"| {s} | {counts[s][0]} | {counts[s][1]} |" for s in subsets)
    return "\n".join([*lines, "---", ""]) + TEXT.format(
        count=len(plan), seed=settings.seed, makers=MAKERS[settings.family], table=table
    )


def set_files(out: Path) -> list[Path]:
    """The set's files below `out`, sorted, without the manifest and without what is being made."""
    found = (p for p in out.rglob("*") if p.is_file() and not any(n.startswith(".") for n in p.relative_to(out).parts))
    return sorted(p for p in found if p != out / "manifest.json")


def digest(path: Path) -> str:
    """SHA-256 of a file in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_card(out: Path, settings: Settings) -> None:
    """Write the card, then the manifest over all files."""
    (out / "README.md").write_text(card_of(settings))
    files = {str(p.relative_to(out)): {"bytes": p.stat().st_size, "sha256": digest(p)} for p in set_files(out)}
    (out / "manifest.json").write_text(json.dumps({**settings.record(), "files": files}, indent=1) + "\n")
