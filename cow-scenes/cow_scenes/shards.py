"""Parquet shards in the layout of the public data set, read from the truth folders."""

import json
import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from .layout import truth_folder
from .plan import ItemKey
from .settings import Settings

SCHEMA = pa.schema(
    [
        ("id", pa.string()),
        ("question", pa.string()),
        ("answer", pa.string()),
        ("image", pa.struct([("bytes", pa.binary()), ("path", pa.string())])),
        ("not_sure", pa.string()),
    ],
    metadata={
        "huggingface": json.dumps(
            {
                "info": {
                    "features": {
                        **{n: {"dtype": "string", "_type": "Value"} for n in ("id", "question", "answer")},
                        "image": {"_type": "Image"},
                        "not_sure": {"dtype": "string", "_type": "Value"},
                    }
                }
            }
        )
    },
)


def row_of(out: Path, key: ItemKey) -> dict:
    """One item's row."""
    folder = truth_folder(out, key)
    meta = json.loads((folder / "meta.json").read_text())
    return {
        "id": key.id,
        "question": meta["question"],
        "answer": f"({meta['answer']})",
        "image": {"bytes": (folder / "image.jpg").read_bytes(), "path": f"{key.id}.jpg"},
        "not_sure": f"({meta['not_sure']})",
    }


def write_shards(out: Path, settings: Settings) -> None:
    """Write all shards again, each under a temporary name first; shards of an earlier, smaller set are removed."""
    by_subset: dict[str, list[ItemKey]] = {}
    for key in settings.plan():
        by_subset.setdefault(key.subset, []).append(key)
    for subset, keys in by_subset.items():
        keys.sort(key=lambda k: (k.level, k.number))
        folder = out / subset
        folder.mkdir(exist_ok=True)
        chunks = [keys[i : i + settings.shard_rows] for i in range(0, len(keys), settings.shard_rows)]
        names = [f"test-{i:05d}-of-{len(chunks):05d}.parquet" for i in range(len(chunks))]
        for name, chunk in zip(names, chunks, strict=True):
            table = pa.Table.from_pylist([row_of(out, key) for key in chunk], SCHEMA)
            # JPEG does not shrink further, and few rows per group let a reader take one image at a time.
            pq.write_table(table, folder / f".{name}", row_group_size=100, compression="snappy")
            os.replace(folder / f".{name}", folder / name)
        for old in folder.glob("*.parquet"):
            if old.name not in names:
                old.unlink()
