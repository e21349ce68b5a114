"""Calls of one model from any thread, written together where they wait together."""

from __future__ import annotations

import gc
import logging
import traceback
from collections import deque
from concurrent.futures import Future, InvalidStateError
from threading import Lock, Thread

import torch

from cow_service.errors import MllmUnavailable
from cow_service.readers.local.engine import Engine, Order, Reply, Wish
from cow_service.weights.device import is_out_of_memory

_log = logging.getLogger(__name__)


class Call:
    """A wish on its way. Canceling its future takes it out of the queue, or ends its reply at the next token."""

    def __init__(self, wish: Wish) -> None:
        self.wish = wish
        # Never marked as running: such a future could no longer be canceled.
        self.future: Future[Reply] = Future()

    def order(self) -> Order:
        """The call as the engine takes it."""
        return Order(self.wish, self._answer, lambda: not self.future.done())

    def fail(self, error: BaseException) -> None:
        """Ends the call with an error, unless nobody waits any more."""
        try:
            self.future.set_exception(error)
        except InvalidStateError:
            _log.debug("a call was canceled as it failed")

    def _answer(self, reply: Reply) -> None:
        try:
            self.future.set_result(reply)
        except InvalidStateError:
            _log.debug("a call was canceled as its reply was complete")


class Worker:
    """The one thread that runs a model. It lives while there are calls, so that it keeps no idle model alive."""

    def __init__(self, engine: Engine, name: str, max_batch: int, threads: int | None = None) -> None:
        self._engine = engine
        self._name = name
        self._max_batch = max_batch
        self._threads = threads  # of the CPU; None for PyTorch's own number
        self._queue: deque[Call] = deque()
        self._lock = Lock()
        self._running = False

    def submit(self, wish: Wish) -> Future[Reply]:
        """The reply to come. Its errors: `MllmUnavailable` out of memory, and those of `Engine.write`."""
        call = Call(wish)
        with self._lock:
            self._queue.append(call)
            if not self._running:
                self._running = True
                # No daemon: one that is stopped in the midst of PyTorch's code takes the whole process down with it.
                Thread(target=self._work, name=f"mllm {self._name}").start()
        return call.future

    def waiting(self) -> int:
        """Calls that are in the queue, canceled ones included."""
        with self._lock:
            return len(self._queue)

    def _work(self) -> None:
        before = torch.get_num_threads()
        torch.set_num_threads(self._threads or before)
        try:
            while calls := self._take():
                self._write(calls)
        finally:
            torch.set_num_threads(before)  # the number is partly the whole process's

    def _take(self) -> list[Call]:
        """The calls of the next batch. None left ends the thread, which the lock keeps a new call from missing."""
        with self._lock:
            calls: list[Call] = []
            while self._queue and len(calls) < self._max_batch:
                call = self._queue.popleft()
                if not call.future.done():
                    calls.append(call)
            self._running = bool(calls)
            return calls

    def _write(self, calls: list[Call]) -> None:
        """Writes a batch. One that fails is split, until the error has found the call that it belongs to."""
        calls = [call for call in calls if not call.future.done()]
        if not calls:
            return
        error = self._try(calls)
        if error is None:
            return
        if len(calls) == 1:
            calls[0].fail(error)
            return
        half = len(calls) // 2
        self._write(calls[:half])
        self._write(calls[half:])

    def _try(self, calls: list[Call]) -> Exception | None:
        try:
            self._engine.write([call.order() for call in calls])
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the callers'; the thread has others to serve
            # The failed frames hold their tensors, and live as long as the traceback does.
            traceback.clear_frames(error.__traceback__)
            failed = error
        else:
            return None
        if is_out_of_memory(failed):
            failed = MllmUnavailable(
                f"'{self._name}' ran out of memory on {self._engine.device} while it wrote {len(calls)} "
                f"repl{'y' if len(calls) == 1 else 'ies'}. Send a smaller image or fewer frames, or set COW_MLLM to a "
                f"smaller model or COW_DEVICE to a larger device."
            )
        gc.collect()
        if self._engine.device.type == "cuda":
            torch.cuda.empty_cache()
        return failed
