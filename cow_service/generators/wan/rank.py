"""The main program of a rank other than 0: `python -m cow_service.generators.wan.rank FD`.

It ends as soon as its pipe does, whatever it is doing: rank 0 is gone then. An error in the middle of a clip ends it,
too, as the other ranks wait for it in vain.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from contextlib import suppress
from multiprocessing.connection import Connection
from queue import SimpleQueue

import torch

from cow_service.concurrency import leave_decisions_to_the_parent
from cow_service.errors import CowError, unforeseen
from cow_service.generators.wan import loading, memory, pipeline
from cow_service.generators.wan.ranks import HOST, FromRank, Load, Share, Sharing, ToRank
from cow_service.observability import logging as logs
from cow_service.weights.device import cpu_threads
from cow_service.weights.manifests import load_manifests

log = logging.getLogger("cow_service")


class _Stopped(Exception):
    """Rank 0 takes no more steps of a clip."""


def work(pipe: Connection[FromRank, ToRank]) -> None:
    """Loads the model, joins the others, and shares clips until the pipe ends."""
    messages: SimpleQueue[ToRank] = SimpleQueue()

    def listen() -> None:
        try:
            while True:
                messages.put(pipe.recv())
        except (EOFError, OSError):
            os._exit(0)

    given = pipe.recv()
    assert isinstance(given, Load)
    logs.set_up(given.settings)
    threading.Thread(target=listen, name="pipe", daemon=True).start()
    device = torch.device(given.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    threads = load_manifests()[given.name].defaults.get("threads")
    with cpu_threads(None if threads is None else int(threads)):
        transformer = loading.load_rank(given.name, given.profile, given.settings, device)
        pipe.send("loaded")
        port = messages.get()
        assert isinstance(port, int)
        wanted = given.profile.acceleration
        store = torch.distributed.TCPStore(HOST, port, wanted.ranks, is_master=False)
        sharing = Sharing(transformer, wanted, given.rank, device, store)

        def on_step(done: int, total: int) -> None:
            if not sharing.goes_on():
                raise _Stopped

        while isinstance(clip := messages.get(), Share):
            with memory.within_memory(device, lambda: None, f"A share of a clip on {device}"), suppress(_Stopped):
                noise, conditioning = clip.unpack()
                sharing.prepare(noise)
                pipeline.denoise(transformer, device, noise, conditioning, clip.sampling, on_step, sharing)


def main(descriptor: int) -> None:
    """Works on the pipe of a file descriptor until it ends."""
    leave_decisions_to_the_parent()
    pipe: Connection[FromRank, ToRank] = Connection(descriptor)
    failed: CowError = unforeseen()  # also after a message that it cannot handle
    try:
        work(pipe)
    except CowError as error:
        failed = error
    except Exception:
        log.exception("a rank failed")
    try:
        pipe.send(failed)
    finally:
        os._exit(1)  # without waiting for the other ranks


if __name__ == "__main__":
    main(int(sys.argv[1]))
