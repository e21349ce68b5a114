"""The worker processes of a server."""

from __future__ import annotations

import psutil
from servers import Served


def workers_of(served: Served) -> list[psutil.Process]:
    """Those that are alive."""
    assert served.process is not None
    alive = [one for one in psutil.Process(served.process.pid).children() if one.status() != psutil.STATUS_ZOMBIE]
    return [one for one in alive if "cow_service.workers" in one.cmdline()]
