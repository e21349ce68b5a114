"""Imports httpx without its command line, which would import two libraries more and take as long as all the rest."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any, cast

COMMAND_LINE = "httpx._main"


def import_httpx() -> None:
    """httpx does without its command line where that cannot be imported; it can be again afterwards."""
    if "httpx" in sys.modules:
        return
    modules = cast(dict[str, Any], sys.modules)
    modules[COMMAND_LINE] = None
    try:
        import_module("httpx")
    finally:
        del modules[COMMAND_LINE]
