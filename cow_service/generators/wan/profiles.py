"""Named ways to run a model, as its manifest lists them: sampling, precision and acceleration together."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, ValidationError, model_validator

from cow_service.errors import GeneratorUnavailable
from cow_service.generators.wan.acceleration import Acceleration
from cow_service.generators.wan.sampling import Sampling
from cow_service.records import Record
from cow_service.weights.manifests import Manifest

Precision = Literal["float32", "bfloat16", "float16"]


class Lora(Record):
    """Low-rank weights that are added to the transformer's when it is loaded."""

    source: str = Field(description="Which of the manifest's sources it is.")
    scale: float = 1.0


class Profile(Record):
    """One way to run a model."""

    summary: str
    sampling: Sampling
    dtype: Precision = Field(default="bfloat16", description="Of the transformer and the encoders.")
    vae_dtype: Precision = Field(
        default="float32", description="Of the VAE; bfloat16 decodes in less time, with slightly banded gradients."
    )
    acceleration: Acceleration = Acceleration()
    lora: Lora | None = None

    @model_validator(mode="after")
    def _ratios_meet_their_steps(self) -> Profile:
        if self.acceleration.cache == "mag" and self.sampling.guidance_window[0] > 0:
            raise ValueError("`cache: mag` counts the steps of each branch: `guidance_window` must begin at 0")
        return self


def profile_of(manifest: Manifest, name: str) -> Profile:
    """The manifest's profile of that name. Raises `GeneratorUnavailable` naming those that it has."""
    if name not in manifest.profiles:
        raise GeneratorUnavailable(
            f"'{manifest.name}' has no profile '{name}'. It has: {', '.join(manifest.profiles)}. Set COW_PROFILE."
        )
    try:
        profile = Profile.model_validate(manifest.profiles[name])
        if profile.lora is not None and profile.lora.source not in manifest.sources:
            raise GeneratorUnavailable(f"'{manifest.name}' has no source '{profile.lora.source}' for its LoRA.")
        return profile
    except ValidationError as error:
        told = "; ".join(f"{'.'.join(str(p) for p in item['loc'])}: {item['msg']}" for item in error.errors())
        raise GeneratorUnavailable(f"Profile '{name}' of '{manifest.name}' is not valid: {told}.") from error
