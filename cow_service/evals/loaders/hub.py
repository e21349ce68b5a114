"""Data sets of the Hugging Face hub, downloaded once."""

from __future__ import annotations

import re
from pathlib import Path

from cow_service.errors import InvalidRequest

CAUSALSPATIAL = "Mwxinnn/CausalSpatial"
_NAME = re.compile(r"[\w.-]+/[\w.-]+", re.ASCII)


def is_hub_name(text: str) -> bool:
    """Whether it may name a data set of the hub: owner/name."""
    return _NAME.fullmatch(text) is not None


def download(name: str) -> Path:
    """The folder of a data set, from the hub (HF_ENDPOINT) or the cache of its library (HF_HOME)."""
    from huggingface_hub import snapshot_download  # noqa: PLC0415
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError  # noqa: PLC0415

    try:
        return Path(snapshot_download(name, repo_type="dataset", allow_patterns=["*.parquet", "**/*.parquet"]))
    except (HfHubHTTPError, LocalEntryNotFoundError, OSError, ValueError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InvalidRequest(
            f"The data set '{name}' is no folder here, and could not be had from the hub: {reason}. Download it where "
            "the network reaches the hub, and name the folder."
        ) from error
