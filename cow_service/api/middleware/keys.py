"""API keys: made at random, stored as hashes only, compared in constant time."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from hashlib import sha256

PREFIX = "cow_"  # lets scanners for leaked secrets know one
ENTROPY_BYTES = 32


def new_key() -> str:
    """A fresh key, random enough that guessing is hopeless and a plain SHA-256 hides it."""
    return PREFIX + secrets.token_urlsafe(ENTROPY_BYTES)


def hash_of(key: str) -> str:
    """The hash as it stands in COW_API_KEYS."""
    # What arrives in a header may hold anything, also what UTF-8 cannot say.
    return "sha256:" + sha256(key.encode(errors="surrogateescape")).hexdigest()


class KeyRing:
    """The hashes of a server's keys, by the name of their owner."""

    def __init__(self, hashes: Mapping[str, str]) -> None:
        self._hashes = {name: value.lower().encode() for name, value in hashes.items()}

    def __len__(self) -> int:
        return len(self._hashes)

    def owner_of(self, key: str) -> str | None:
        """The owner's name, or None where nobody has that key."""
        asked = hash_of(key).encode()
        owner = None
        for name, known in self._hashes.items():  # all of them, so that the time is always the same
            if hmac.compare_digest(asked, known):
                owner = name
        return owner
