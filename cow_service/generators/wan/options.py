"""What a video model takes of a request. Checked without its libraries: a server that has none passes jobs on."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from cow_service.generators.wan.tracks import nearest_lengths


class WanOptions(BaseModel):
    """What `generator_options` may hold for a video model. What is not given is as the profile says."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    steps: int | None = Field(default=None, ge=1, le=200, description="Denoising steps.")
    shift: float | None = Field(default=None, gt=0, le=50, description="Shift of the noise schedule.")
    guidance_scale: float | None = Field(default=None, ge=0, le=30, description="1 does without guidance.")
    prompt: str | None = Field(default=None, max_length=4000, description="By default the sentence of the motion.")
    negative_prompt: str | None = Field(default=None, max_length=4000, description="By default that of the model.")
    clean_cues: bool = Field(default=True, description="Take drawn arrows and boxes out of the first frame.")


class WanLimits:
    """Options and lengths of a clip."""

    options_model = WanOptions

    def nearest_lengths(self, num_frames: int) -> tuple[int, ...]:
        """4n + 1 frames, 5 to 81."""
        return nearest_lengths(num_frames)
