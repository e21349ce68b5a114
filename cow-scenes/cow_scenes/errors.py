"""Errors that a caller can act on.

ScenesError
├── UsageError       a bad argument or input; the command ends with code 2
├── NoWorldError     no world with the wanted answer was found for an item
├── ItemsFailedError items whose process crashed or raised twice
└── CheckError       a made set is not what it says it is
"""


class ScenesError(Exception):
    """What the package raises; the message names the value and the remedy."""


class UsageError(ScenesError):
    """An argument or an input folder cannot be used as given."""


class NoWorldError(ScenesError):
    """Rejection sampling found no world within its tries."""


class ItemsFailedError(ScenesError):
    """Some items could not be made; the others stand."""


class CheckError(ScenesError):
    """A made set disagrees with its own truth records."""
