"""Whether a server could listen, looked at before anything is loaded."""

from __future__ import annotations

import errno
import socket

from cow_service.settings import Settings, SettingsError


def check_port(settings: Settings) -> None:
    """Raises `SettingsError` where nobody can listen at the server's address and port."""
    host, port = settings.host, settings.port
    if port == 0:
        return
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except socket.gaierror as error:
        raise SettingsError(f"Bad settings: COW_HOST={host}: {error.strerror}.") from error
    for family, kind, protocol, _, address in found:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
            except OSError as error:
                raise SettingsError(f"Bad settings: COW_PORT={port}: {_reason(error, host)}") from error


def _reason(error: OSError, host: str) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"another program listens there, at {host}. Choose another with --port; --port 0 takes a free one."
    if error.errno == errno.EACCES:
        return "only the system's administrator may listen there. Choose a --port above 1023."
    return f"{error.strerror}. See --host and --port."
