"""What is served without a key though the server has keys: pages and their files, which hold nothing of any caller."""

from __future__ import annotations

from starlette.types import Scope

PATHS = frozenset({"/", "/docs"})
PREFIXES = ("/docs/", "/web/")


def is_page(scope: Scope) -> bool:
    """Whether a request is for a page or a file of one: what the page then asks for needs the key as ever."""
    if scope["type"] != "http" or scope["method"] not in ("GET", "HEAD"):
        return False
    return scope["path"] in PATHS or scope["path"].startswith(PREFIXES)
