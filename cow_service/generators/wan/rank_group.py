"""Rank 0's side of several processes that share clips: it starts them, one for each further GPU, and watches them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, distributed

from cow_service.concurrency import spawn
from cow_service.errors import CowError, DeviceFailed, GeneratorOutOfMemory, InternalError, WorkerEnded, kinds
from cow_service.generators.wan.denoising import Conditioning, StepCallback, denoise
from cow_service.generators.wan.profiles import Profile
from cow_service.generators.wan.rank_messages import Array, Failed, FromRank, Join, Load, Share, ToRank
from cow_service.generators.wan.sampling import Sampling
from cow_service.generators.wan.sharing import HOST, Sharing
from cow_service.settings import Settings
from cow_service.weights.device import is_out_of_memory

MODULE = "cow_service.generators.wan.rank"
POLL_SECONDS = 0.2  # how often the ranks that are met are looked after
NOTICE_SECONDS = 2.0  # in which the end of a process is noticed, once another one has failed because of it


class RankGroup:
    """The processes of ranks 1 and up. They end with this process, and with the group.

    Once one of them has ended, or rank 0 has left a clip in the middle of a step, the group shares no more clips.
    """

    def __init__(self, name: str, profile: Profile, settings: Settings, device: torch.device) -> None:
        """Starts them; they load the model of this name and profile, on the GPUs after rank 0's `device`."""
        self._wanted, self._device = profile.acceleration, device
        self._sharing: Sharing | None = None
        self._transformer: object = None
        self._is_over = False
        self._first_error: CowError | None = None
        self._ranks = [_Rank(number, device, self._ended) for number in range(1, self._wanted.ranks)]
        for rank in self._ranks:
            rank.send(Load(rank.number, str(rank.device), name, profile, settings))

    def join(self, transformer: object) -> None:
        """Meets them, once all have loaded. Raises the `CowError` for which one has not, or cannot be met."""
        for rank in self._ranks:
            rank.loaded.wait()
        self._check()
        self._transformer = transformer
        met, errors = threading.Event(), list[BaseException]()

        def meet() -> None:
            try:
                self._sharing = self._met(transformer)
            except BaseException as error:  # noqa: BLE001 - raised below
                errors.append(error)
            finally:
                met.set()

        # Whoever waits for another rank there hears nothing of its end, for minutes or for ever.
        threading.Thread(target=meet, name="cow-ranks-meet", daemon=True).start()
        while not met.wait(POLL_SECONDS):
            self._check()
        if errors:
            self._check()
            raise errors[0]

    def denoise(self, noise: Tensor, given: Conditioning, sampling: Sampling, on_step: StepCallback) -> Tensor:
        """As `denoising.denoise`, with all ranks. Raises `DeviceFailed` where one of them was lost."""
        self._check()
        sharing, stopped = self._sharing, False
        assert sharing is not None

        def told(done: int, total: int) -> None:
            nonlocal stopped
            try:
                on_step(done, total)
            except BaseException:
                sharing.tell(go_on=False)
                stopped = True
                raise
            sharing.tell(go_on=True)

        clip = _shared(noise, given, sampling)
        for rank in self._ranks:
            rank.send(clip)
        try:
            sharing.prepare(noise)
            return denoise(self._transformer, self._device, noise, given, sampling, told, sharing)
        except BaseException as error:
            if stopped:  # between two steps: every rank knows
                raise
            if is_out_of_memory(error) or not isinstance(error, Exception):
                self.close()
                raise
            for rank in self._ranks:  # an error of a connection may be heard before the end of what was connected
                rank.has_ended.wait(NOTICE_SECONDS / len(self._ranks))
            lost = self._lost()
            self.close()
            if lost is None:  # the error is this process's own
                raise
            raise (lost if isinstance(lost, GeneratorOutOfMemory) else _failure(lost)) from error

    def close(self) -> None:
        """Ends the processes. No more clips are shared."""
        self._is_over = True
        for rank in self._ranks:
            rank.end()
        if self._sharing is not None:
            self._sharing.leave()

    def _met(self, transformer: object) -> Sharing:
        count = self._wanted.ranks
        store = distributed.TCPStore(HOST, 0, count, is_master=True, wait_for_workers=False)
        for rank in self._ranks:
            rank.send(Join(store.port))
        return Sharing(transformer, self._wanted, 0, self._device, store)

    def _ended(self) -> None:
        if not self._is_over and self._sharing is not None:
            self._sharing.leave()

    def _check(self) -> None:
        lost = self._lost()
        if lost is None and not self._is_over:
            return
        self.close()
        raise lost if lost is not None and self._sharing is None else _failure(lost)

    def _lost(self) -> CowError | None:
        """For what a rank has ended; None where none has, but by `close`."""
        if self._is_over or not any(rank.has_ended.is_set() for rank in self._ranks):
            return self._first_error
        errors = [rank.error for rank in self._ranks if rank.error is not None]
        unknown = WorkerEnded("The process of one of the GPUs ended.")
        self._first_error = next((error for error in errors if not isinstance(error, InternalError)), unknown)
        return self._first_error


def _failure(lost: CowError | None) -> DeviceFailed:
    reason = "A clip ended in the middle of a step." if lost is None else lost.detail
    return DeviceFailed(
        f"The GPUs that share clips do so no more. {reason} A worker process is replaced, with those of its GPUs, and "
        "the job tried again; without workers (COW_WORKERS=false) restart the server."
    )


class _Rank:
    """One of the other processes."""

    def __init__(self, number: int, first: torch.device, on_end: Callable[[], None]) -> None:
        """`first`: the device of rank 0. `on_end` is called once the process has ended."""
        self.number = number
        self.device = first if first.type == "cpu" else torch.device(first.type, (first.index or 0) + number)
        self.loaded = threading.Event()  # or ended
        self.has_ended = threading.Event()
        self.error: CowError | None = None
        self._spawned = spawn(MODULE)
        self._on_end = on_end
        threading.Thread(target=self._listen, name=f"cow-rank-{number}", daemon=True).start()

    def send(self, message: ToRank) -> None:
        """Does nothing once the process has ended."""
        try:
            self._spawned.pipe.send(message)
        except OSError:
            self._spawned.process.kill()

    def end(self) -> None:
        """Ends the process at once."""
        self._spawned.process.kill()
        self._spawned.process.wait()

    def _listen(self) -> None:
        pipe, process = self._spawned.pipe, self._spawned.process
        try:
            while True:
                message: FromRank = pipe.recv()
                if isinstance(message, Failed):
                    self.error = kinds().get(message.code, InternalError)(message.detail)
                else:
                    self.loaded.set()
        except (EOFError, OSError):
            pass
        process.wait()
        self.has_ended.set()
        self.loaded.set()
        self._on_end()


def _shared(noise: Tensor, given: Conditioning, sampling: Sampling) -> Share:
    negative = given.negative_prompt
    return Share(
        noise=_array(noise),
        prompt=_array(given.prompt),
        negative_prompt=None if negative is None else _array(negative),
        image=_array(given.image),
        condition=_array(given.condition),
        unconditional=_array(given.unconditional),
        sampling=sampling,
    )


def _array(tensor: Tensor) -> Array:
    """Exact: no tensor of a clip is more precise than float32."""
    found: Any = tensor.detach().float().cpu().numpy()
    return found
