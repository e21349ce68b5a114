"""Rows of Parquet files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cow_service.evals.loaders.rows import FileFault

_AT_ONCE = 64  # rows: a row may hold a picture of a megabyte


def parquet_rows(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a file. Raises `FileFault` for a file that is none, or is not whole."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    try:
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(batch_size=_AT_ONCE):
                yield from batch.to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise FileFault(f"{path.name}: no whole Parquet file ({str(error).splitlines()[0]}); get it again") from error
