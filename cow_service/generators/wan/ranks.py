"""Several processes, each with a GPU, share the work of one clip.

Every process is a rank with the whole transformer, and takes every step with the same latents. With guidance
parallelism one half of the ranks computes the guided pass and the other half the unconditional one; with context
parallelism the ranks of a half, or all, split the tokens of each pass in every layer (Ulysses, by diffusers).

`RankGroup` is rank 0's side, in the process of the generator: it starts the other ranks (`rank`), watches them and
sends messages over a pipe to each. `Sharing` is what every rank does within a clip.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Literal, cast

import diffusers
import torch
from safetensors.torch import load, save
from torch import Tensor, distributed

from cow_service.concurrency import spawn
from cow_service.errors import CowError, DeviceFailed, GeneratorOutOfMemory, InternalError, WorkerEnded
from cow_service.generators.wan.pipeline import Branch, Conditioning, StepCallback, denoise
from cow_service.generators.wan.profiles import Acceleration, Profile, Sampling
from cow_service.settings import Settings
from cow_service.weights.device import is_out_of_memory

MODULE = "cow_service.generators.wan.rank"
POLL_SECONDS = 0.2  # how often rank 0 looks whether a rank has ended while it waits for all to join
NOTICE_SECONDS = 2.0  # in which the end of a process is noticed, once another one has failed because of it
HOST = "127.0.0.1"
TIMEOUT = timedelta(minutes=10)  # that a rank waits for another one within a step
PATCH = 4  # latent cells per token


@dataclass(frozen=True)
class Load:
    """The first message to a rank: which model, in which way. The profile's attention backend is chosen already."""

    rank: int
    device: str
    name: str  # of the manifest
    profile: Profile
    settings: Settings


@dataclass(frozen=True)
class Share:
    """To a rank: take part in a clip. The arguments of `denoise`."""

    tensors: bytes  # the noise, and the conditioning by its fields, as a safetensors file
    sampling: Sampling

    @classmethod
    def pack(cls, noise: Tensor, given: Conditioning, sampling: Sampling) -> Share:
        """The message for tensors of any device."""
        parts: dict[str, Tensor | None] = {"noise": noise, **vars(given)}
        tensors = {name: part.cpu().contiguous().clone() for name, part in parts.items() if part is not None}
        return cls(save(tensors), sampling)

    def unpack(self) -> tuple[Tensor, Conditioning]:
        """The noise and the conditioning, on the CPU."""
        absent: dict[str, Any] = dict.fromkeys(("negative_prompt", "image", "coarse", "moving"))
        tensors = absent | load(self.tensors)
        return tensors.pop("noise"), Conditioning(**tensors)


Port = int  # where the ranks meet, once all have loaded
ToRank = Load | Port | Share
FromRank = Literal["loaded"] | CowError  # that it ends, and why


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

        def abort() -> None:  # one of the processes has ended: do not wait for it
            if not self._is_over and self._sharing is not None:
                self._sharing.leave()

        self._ranks = [_Rank(number, device, abort) for number in range(1, self._wanted.ranks)]
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
                store = distributed.TCPStore(HOST, 0, self._wanted.ranks, is_master=True, wait_for_workers=False)
                for rank in self._ranks:
                    rank.send(store.port)
                self._sharing = Sharing(transformer, self._wanted, 0, self._device, store)
            except BaseException as error:  # noqa: BLE001 - raised below
                errors.append(error)
            finally:
                met.set()

        # In a thread, because a rank that waits for another one may not notice its end for minutes, or ever.
        threading.Thread(target=meet, name="cow-ranks-meet", daemon=True).start()
        while not met.wait(POLL_SECONDS):
            self._check()
        if errors:
            self._check()
            raise errors[0]

    def denoise(self, noise: Tensor, given: Conditioning, sampling: Sampling, on_step: StepCallback) -> Tensor:
        """As `pipeline.denoise`, with all ranks. Raises `DeviceFailed` if one of them was lost."""
        self._check()
        sharing, stopped = self._sharing, False
        assert sharing is not None

        def tell_ranks(done: int, total: int) -> None:
            nonlocal stopped
            try:
                on_step(done, total)
            except BaseException:
                sharing.goes_on(False)
                stopped = True
                raise
            sharing.goes_on()

        clip = Share.pack(noise, given, sampling)
        for rank in self._ranks:
            rank.send(clip)
        try:
            sharing.prepare(noise)
            return denoise(self._transformer, self._device, noise, given, sampling, tell_ranks, sharing)
        except BaseException as error:
            if stopped:  # between two steps: every rank knows
                raise
            if is_out_of_memory(error) or not isinstance(error, Exception):
                self.close()
                raise
            for rank in self._ranks:  # an error of a connection may come before the end of what was connected
                rank.has_ended.wait(NOTICE_SECONDS / len(self._ranks))
            lost = self._find_lost()
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

    def _check(self) -> None:
        lost = self._find_lost()
        if lost is None and not self._is_over:
            return
        self.close()
        raise lost if lost is not None and self._sharing is None else _failure(lost)

    def _find_lost(self) -> CowError | None:
        """Why a rank has ended; None if none has, but by `close`."""
        if not self._is_over and any(rank.has_ended.is_set() for rank in self._ranks):
            errors = [rank.error for rank in self._ranks if rank.error is not None]
            unknown = WorkerEnded("The process of one of the GPUs ended.")
            self._first_error = next((error for error in errors if not isinstance(error, InternalError)), unknown)
        return self._first_error


def _failure(lost: CowError | None) -> DeviceFailed:
    reason = "A clip ended in the middle of a step." if lost is None else lost.detail
    return DeviceFailed(
        f"The GPUs can no longer share clips. {reason} A worker process is replaced, with those of its GPUs, and "
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

        def listen() -> None:
            try:
                while True:
                    message: FromRank = self._spawned.pipe.recv()
                    if isinstance(message, CowError):
                        self.error = message
                    else:
                        self.loaded.set()
            except (EOFError, OSError):
                pass
            self._spawned.process.wait()
            self.has_ended.set()
            self.loaded.set()
            on_end()

        threading.Thread(target=listen, name=f"cow-rank-{number}", daemon=True).start()

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


class Sharing:
    """One rank's part in the clips of all."""

    def __init__(
        self, transformer: object, wanted: Acceleration, rank: int, device: torch.device, store: distributed.Store
    ) -> None:
        """Joins the other ranks: every one has to, at the same time. `store` is where they meet."""
        self._transformer: Any = transformer
        self._wanted, self._rank, self._device = wanted, rank, device
        self._leaving = threading.Lock()
        os.environ.setdefault("TORCH_NCCL_ASYNC_ERROR_HANDLING", "0")  # else NCCL's watchdog may end this process
        self._use_device()
        distributed.init_process_group(
            "nccl" if device.type == "cuda" else "gloo",
            store=store,
            rank=rank,
            world_size=wanted.ranks,
            timeout=TIMEOUT,
            device_id=device if device.type == "cuda" else None,
        )
        self._context: Any = None
        if (parts := wanted.context_parallel) > 1:
            size = 2 if wanted.guidance_parallel else 1, 1, parts
            mesh = distributed.init_device_mesh(device.type, size, mesh_dim_names=("guidance", "ring", "ulysses"))
            self._context = cast(Any, diffusers).ContextParallelConfig(ulysses_degree=parts, mesh=mesh)
            self._transformer.enable_parallelism(config=self._context)

    def prepare(self, noise: Tensor) -> None:
        """Called before each clip. `noise` [1, C, T, h, w] has its size: any number of tokens can be split."""
        self._use_device()
        if self._context is not None:
            tokens = noise[0, 0].numel() // PATCH
            # Parts of different lengths have to tell each other how long they are, in every layer.
            self._context.ulysses_anything = tokens % self._wanted.context_parallel != 0

    def __call__(self, branch: Branch, compute: Callable[[], Tensor], like: Tensor) -> Tensor:
        """The result of a pass, on every rank: computed here, or by the other half."""
        if not self._wanted.guidance_parallel:
            return compute()
        first = 0 if branch == "cond" else self._wanted.context_parallel  # of the ranks that compute it
        own = first <= self._rank < first + self._wanted.context_parallel
        velocity = compute().contiguous() if own else torch.empty_like(like)
        distributed.broadcast(velocity, src=first)
        return velocity

    def goes_on(self, decision: bool = True) -> bool:
        """After every step, on every rank: whether there is a next one. Rank 0 decides."""
        said = torch.tensor([decision], dtype=torch.uint8, device=self._device)
        distributed.broadcast(said, src=0)
        return bool(said.item())

    def leave(self) -> None:
        """Ends whatever waits for another rank, from any thread. The ranks cannot share a clip any more."""
        with self._leaving:
            if distributed.is_initialized():
                # The only call that ends a wait for another rank, also in subgroups.
                distributed.distributed_c10d._abort_process_group()  # pyright: ignore[reportPrivateUsage]

    def _use_device(self) -> None:
        """Of this thread: diffusers makes some tensors on the current device."""
        if self._device.type == "cuda":
            torch.cuda.set_device(self._device)
