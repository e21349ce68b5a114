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
from torch import Tensor, distributed

from cow_service.concurrency import leave_decisions_to_the_parent
from cow_service.errors import CowError, unforeseen
from cow_service.generators.wan.denoising import Conditioning, denoise
from cow_service.generators.wan.execution import within_memory
from cow_service.generators.wan.loading import load_rank
from cow_service.generators.wan.rank_messages import Array, Failed, FromRank, Join, Load, Loaded, Share, ToRank
from cow_service.generators.wan.sharing import HOST, Sharing
from cow_service.observability import logging as logs
from cow_service.weights.device import cpu_threads
from cow_service.weights.manifests import load_manifests

log = logging.getLogger("cow_service")


class _Stopped(Exception):
    """Rank 0 wants no more steps."""


def work(pipe: Connection[FromRank, ToRank]) -> None:
    """Loads the model, joins the others, and shares clips until the pipe ends."""
    messages: SimpleQueue[ToRank] = SimpleQueue()
    given = pipe.recv()
    assert isinstance(given, Load)
    logs.set_up(given.settings)
    threading.Thread(target=_listen, args=(pipe, messages), name="pipe", daemon=True).start()
    device = torch.device(given.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    threads = load_manifests()[given.name].defaults.get("threads")
    with cpu_threads(None if threads is None else int(threads)):
        transformer = load_rank(given.name, given.profile, given.settings, device)
        pipe.send(Loaded())
        join = messages.get()
        assert isinstance(join, Join)
        wanted = given.profile.acceleration
        store = distributed.TCPStore(HOST, join.port, wanted.ranks, is_master=False)
        sharing = Sharing(transformer, wanted, given.rank, device, store)
        while isinstance(clip := messages.get(), Share):
            with within_memory(device, lambda: None, f"A share of a clip on {device}"):
                _share(clip, transformer, device, sharing)


def _listen(pipe: Connection[FromRank, ToRank], messages: SimpleQueue[ToRank]) -> None:
    try:
        while True:
            messages.put(pipe.recv())
    except (EOFError, OSError):
        os._exit(0)


def _share(clip: Share, transformer: object, device: torch.device, sharing: Sharing) -> None:
    def on_step(done: int, total: int) -> None:
        if not sharing.hear():
            raise _Stopped

    negative = None if clip.negative_prompt is None else _tensor(clip.negative_prompt)
    given = Conditioning(
        prompt=_tensor(clip.prompt),
        negative_prompt=negative,
        image=_tensor(clip.image),
        condition=_tensor(clip.condition),
        unconditional=_tensor(clip.unconditional),
    )
    noise = _tensor(clip.noise)
    sharing.prepare(noise)
    with suppress(_Stopped):
        denoise(transformer, device, noise, given, clip.sampling, on_step, sharing)


def _tensor(array: Array) -> Tensor:
    return torch.from_numpy(array)


def main(descriptor: int) -> None:
    """Works on the pipe of a file descriptor until it ends."""
    leave_decisions_to_the_parent()
    pipe: Connection[FromRank, ToRank] = Connection(descriptor)
    try:
        work(pipe)
    except CowError as error:
        failed = error
    except Exception:
        log.exception("a rank failed")
        failed = unforeseen()
    else:
        failed = unforeseen()  # it was told what it cannot do
    try:
        pipe.send(Failed(failed.code, failed.detail))
    finally:
        os._exit(1)  # without waiting for the other ranks


if __name__ == "__main__":
    main(int(sys.argv[1]))
