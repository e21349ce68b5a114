"""How several processes, each with a GPU, share the work of one clip: what each computes, and how they agree.

Every process is a rank with the whole model, and takes every step with the same latents. With guidance parallelism one
half of the ranks computes the guided pass and the other half the unconditional one; with context parallelism the ranks
of a half, or all, split the tokens of each pass in every layer (Ulysses, by diffusers).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from datetime import timedelta
from typing import Any, cast

import diffusers
import torch
from torch import Tensor, distributed
from torch.distributed import distributed_c10d
from torch.distributed.device_mesh import DeviceMesh, init_device_mesh

from cow_service.generators.wan.denoising import Branch
from cow_service.generators.wan.profiles import Acceleration

HOST = "127.0.0.1"
TIMEOUT = timedelta(minutes=10)  # that a rank waits for another one within a step
PATCH = 4  # latent cells per token


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
        self._context = self._split_context() if wanted.context_parallel > 1 else None

    def prepare(self, noise: Tensor) -> None:
        """Before each clip, of which `noise` [1, 16, T, h, w] has the size: any number of tokens can be split."""
        self._use_device()
        if self._context is not None:
            tokens = noise[0, 0].numel() // PATCH
            # Parts of different lengths have to tell each other how long they are, in every layer.
            self._context.ulysses_anything = tokens % self._wanted.context_parallel != 0

    def __call__(self, branch: Branch, compute: Callable[[], Tensor], like: Tensor) -> Tensor:
        """What a pass comes to, on every rank: computed here, or by the other half."""
        if not self._wanted.guidance_parallel:
            return compute()
        first = 0 if branch == "cond" else self._wanted.context_parallel  # of the ranks that compute it
        own = first <= self._rank < first + self._wanted.context_parallel
        velocity = compute().contiguous() if own else torch.empty_like(like)
        distributed.broadcast(velocity, src=first)
        return velocity

    def tell(self, *, go_on: bool) -> None:
        """Rank 0, after every step: whether there is a next one."""
        distributed.broadcast(torch.tensor([go_on], dtype=torch.uint8, device=self._device), src=0)

    def hear(self) -> bool:
        """The other ranks: what rank 0 tells."""
        said = torch.empty(1, dtype=torch.uint8, device=self._device)
        distributed.broadcast(said, src=0)
        return bool(said.item())

    def leave(self) -> None:
        """Ends whatever waits for another rank, from any thread. The ranks cannot share a clip any more."""
        with self._leaving:
            if distributed.is_initialized():
                distributed_c10d._abort_process_group()  # pyright: ignore[reportPrivateUsage] - of all subgroups, too

    def _use_device(self) -> None:
        """Of this thread: diffusers makes some tensors on the current device."""
        if self._device.type == "cuda":
            torch.cuda.set_device(self._device)

    def _split_context(self) -> Any:
        halves = 2 if self._wanted.guidance_parallel else 1
        size = halves, 1, self._wanted.context_parallel
        heads = self._transformer.config.num_attention_heads
        if heads % self._wanted.context_parallel:
            raise ValueError(f"{heads} attention heads cannot be split among {self._wanted.context_parallel} GPUs")
        mesh: DeviceMesh = init_device_mesh(self._device.type, size, mesh_dim_names=("guidance", "ring", "ulysses"))
        config = cast(Any, diffusers).ContextParallelConfig(ulysses_degree=self._wanted.context_parallel, mesh=mesh)
        self._transformer.enable_parallelism(config=config)
        return config
