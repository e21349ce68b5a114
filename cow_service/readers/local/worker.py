"""Generates replies for calls from any thread; those that wait together are written as one batch."""

from __future__ import annotations

import gc
import traceback
from collections import deque
from concurrent.futures import Future
from threading import Lock, Thread

import torch

from cow_service.errors import MllmUnavailable
from cow_service.readers.local.batch_generator import BatchGenerator, Generation, GenerationRequest, PendingGeneration
from cow_service.weights.device import cpu_threads, is_out_of_memory


class BatchWorker:
    """The one thread that runs a model. It lives while there are requests, so that it keeps no idle model alive."""

    def __init__(self, generator: BatchGenerator, name: str, max_batch: int, threads: int | None = None) -> None:
        self._generator = generator
        self._name = name
        self._max_batch = max_batch
        self._threads = threads  # of the CPU; None for PyTorch's own number
        self._queue: deque[PendingGeneration] = deque()
        self._lock = Lock()
        self._running = False

    def submit(self, request: GenerationRequest) -> Future[Generation]:
        """The reply to come; canceling it takes it out of the queue, or ends it at the next token.

        Its errors: `MllmUnavailable` out of memory, and those of `BatchGenerator.generate`.
        """
        pending = PendingGeneration(request)
        with self._lock:
            self._queue.append(pending)
            if not self._running:
                self._running = True
                # No daemon: one that is stopped in the midst of PyTorch's code takes the whole process down with it.
                Thread(target=self._work, name=f"mllm {self._name}").start()
        return pending.future

    def _work(self) -> None:
        with cpu_threads(self._threads):
            while batch := self._take():
                self._generate(batch)

    def _take(self) -> list[PendingGeneration]:
        """The next batch. An empty one ends the thread, which the lock keeps a new request from missing."""
        with self._lock:
            batch: list[PendingGeneration] = []
            while self._queue and len(batch) < self._max_batch:
                pending = self._queue.popleft()
                if not pending.future.done():
                    batch.append(pending)
            self._running = bool(batch)
            return batch

    def _generate(self, batch: list[PendingGeneration]) -> None:
        """Generates a batch. One that fails is split, until the error has found the request that it belongs to."""
        batch = [pending for pending in batch if not pending.future.done()]
        error = self._try(batch) if batch else None
        if error is None:
            return
        if len(batch) == 1:
            batch[0].fail(error)
            return
        half = len(batch) // 2
        self._generate(batch[:half])
        self._generate(batch[half:])

    def _try(self, batch: list[PendingGeneration]) -> Exception | None:
        try:
            self._generator.generate(batch)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the callers'; the thread has others to serve
            # The failed frames hold their tensors, and live as long as the traceback does.
            traceback.clear_frames(error.__traceback__)
            failed = error
        else:
            return None
        if is_out_of_memory(failed):
            failed = MllmUnavailable(
                f"'{self._name}' ran out of memory on {self._generator.device} while it wrote {len(batch)} "
                f"repl{'y' if len(batch) == 1 else 'ies'}. Send a smaller image or fewer frames, or set COW_MLLM to a "
                f"smaller model or COW_DEVICE to a larger device."
            )
        gc.collect()
        if self._generator.device.type == "cuda":
            torch.cuda.empty_cache()
        return failed
