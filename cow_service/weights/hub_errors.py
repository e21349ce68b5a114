"""Why a download failed, in words: the one place where exceptions of the hub's library become ours."""

from __future__ import annotations

import errno
from collections.abc import Generator
from contextlib import contextmanager

from cow_service.errors import CowError, WeightsUnavailable

_LOG_IN = "Log in with `hf auth login`, or set HF_TOKEN, for an account that may read it"
_REACH = "Check the network, the proxy and HF_ENDPOINT, and run it again"
_AGAIN = "Run it again: files that are whole stay"

# By the names of exceptions: those of the HTTP library, which differs between versions of huggingface_hub, are among
# them. The first that fits is told: the reason, then the remedy.
REASONS: tuple[tuple[str, str, str], ...] = (
    ("GatedRepoError", "its owner has not granted access", f"Ask for it on the repository's page. {_LOG_IN}"),
    ("RepositoryNotFoundError", "the hub knows no such repository, or it is private", f"Check the name. {_LOG_IN}"),
    ("RevisionNotFoundError", "it has no revision '{revision}'", "Name one that it has, such as --revision main"),
    ("RemoteEntryNotFoundError", "a file is no longer there", "Choose another revision, such as --revision main"),
    ("DisabledRepoError", "the hub has disabled it", "Choose another revision or another model"),
    ("OfflineModeIsEnabled", "HF_HUB_OFFLINE is set", "Unset it to download"),
    ("FileMetadataError", "what answered does not speak like the hub", "Check HF_ENDPOINT, the proxy and the firewall"),
    ("TimeoutException", "the hub did not answer in time", _AGAIN),
    ("TimeoutError", "the hub did not answer in time", _AGAIN),
    ("TransportError", "the hub cannot be reached", _REACH),
    ("ConnectionError", "the hub cannot be reached", _REACH),
)


@contextmanager
def download_told(repository: str, revision: str | None) -> Generator[None]:
    """Whatever the library raises becomes a `WeightsUnavailable` with the reason and a remedy."""
    try:
        yield
    except CowError:
        raise
    except Exception as error:
        reason, remedy = _reason(_root(error))
        raise refused(repository, reason.format(revision=revision or "main"), remedy) from error


def refused(repository: str, reason: str, remedy: str) -> WeightsUnavailable:
    """The error that says why a repository cannot be downloaded, and what to do about it."""
    return WeightsUnavailable(f"'{repository}' cannot be downloaded: {reason}. {remedy}.")


def _root(error: BaseException) -> BaseException:
    """The library hides what went wrong on the line behind a file that it has not found here either."""
    while type(error).__name__ == "LocalEntryNotFoundError" and error.__cause__ is not None:
        error = error.__cause__
    return error


def _reason(error: BaseException) -> tuple[str, str]:
    kinds = {kind.__name__ for kind in type(error).__mro__}
    for name, reason, remedy in REASONS:
        if name in kinds:
            return reason, remedy
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403):
        return f"it is not open to this account (HTTP {status})", _LOG_IN
    if status is not None:
        return f"the hub answered with HTTP {status}", "Wait a little and run it again"
    if isinstance(error, OSError) and error.errno:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return "the disk is full", "Free some space, or set COW_MODELS_DIR to a folder on a larger disk"
        return f"the folder for weights cannot be used ({errno.errorcode.get(error.errno)})", "Make it writable"
    return f"the download failed ({type(error).__name__})", _AGAIN
