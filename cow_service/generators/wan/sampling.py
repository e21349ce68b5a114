"""How a clip is sampled: steps, noise schedule and guidance."""

from __future__ import annotations

from typing import Any, Literal, Protocol, cast

import numpy as np
import torch
from diffusers import FlowMatchEulerDiscreteScheduler, UniPCMultistepScheduler
from pydantic import Field, model_validator
from torch import Tensor

from cow_service.records import Record

TRAIN_STEPS = 1000


class Schedule(Protocol):
    """What is used of diffusers' schedulers, whose own annotations are too narrow."""

    timesteps: Tensor

    def step(self, model_output: Tensor, timestep: Tensor, sample: Tensor, *, return_dict: bool) -> tuple[Tensor, ...]:
        """The sample at the next noise level."""
        ...


class Sampling(Record):
    """Steps, noise schedule and guidance of one clip."""

    solver: Literal["unipc", "euler"] = Field(
        default="unipc", description="unipc for the model as trained; euler for weights distilled to a few steps."
    )
    steps: int = Field(ge=1, le=200, description="Denoising steps; the time grows with them.")
    shift: float = Field(
        gt=0, le=50, description="Above 1 more steps are spent at high noise, where motion is settled."
    )
    guidance_scale: float = Field(
        ge=0, le=30, description="How strongly the prompt steers; at 1 the second pass of each step falls away."
    )
    guidance_window: tuple[float, float] = Field(
        default=(0.0, 1.0),
        description="Share of the steps, from and to, that are guided; each step outside takes half the time.",
    )

    @model_validator(mode="after")
    def _window_is_ordered(self) -> Sampling:
        if not 0 <= self.guidance_window[0] <= self.guidance_window[1] <= 1:
            raise ValueError(f"`guidance_window` [from, to] lies within 0 to 1 in order, got {self.guidance_window}")
        return self

    def guides(self, step: int) -> bool:
        """Whether step 0 <= `step` < `steps` takes the second, unconditional pass."""
        begin, end = self.guidance_window
        return self.guidance_scale != 1 and begin <= step / self.steps < end

    @property
    def guided(self) -> bool:
        """Whether any step takes the second pass."""
        return any(self.guides(step) for step in range(self.steps))

    def schedule(self, device: torch.device) -> Schedule:
        """A fresh scheduler with its steps set; it holds the state of one clip.

        UniPC starts at the noise level of the public Wan2.1 implementation, 0.999 before the shift (diffusers: 1.0).
        """
        if self.solver == "euler":
            # Distilled weights know the noise levels 1, 1 - 1/n, ... before the shift (lightx2v: 1000, 750, 500, 250).
            euler = FlowMatchEulerDiscreteScheduler(num_train_timesteps=TRAIN_STEPS, shift=self.shift)
            euler.set_timesteps(sigmas=[1 - i / self.steps for i in range(self.steps)], device=device)
            euler.set_begin_index(0)
            return cast(Schedule, euler)
        unipc = UniPCMultistepScheduler(
            num_train_timesteps=TRAIN_STEPS,
            prediction_type="flow_prediction",
            use_flow_sigmas=True,
            flow_shift=self.shift,
        )
        highest = 1 - 1 / TRAIN_STEPS
        unipc.set_timesteps(sigmas=cast(Any, np.linspace(highest, 0, self.steps + 1)[:-1]), device=device)
        # Steps are counted: found by their times, which are whole numbers, two with the same would be taken for one.
        unipc.set_begin_index(0)
        return cast(Schedule, unipc)
