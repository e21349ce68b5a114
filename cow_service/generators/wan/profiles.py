"""How a video model is run: what a request may ask for, and named profiles of sampling, precision and acceleration.

Without the model's libraries: a server that has none checks requests and passes them on.
"""

import math
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from cow_service.errors import GeneratorUnavailable
from cow_service.records import Record
from cow_service.weights.manifests import Manifest

Precision = Literal["float32", "bfloat16", "float16"]
LONGEST_SECONDS = 5.0  # 81 frames at 16 per second
IMAGE_ENCODER_DTYPE: Precision = "float32"  # in every profile: the public implementations do not run it in bfloat16


COARSE = (
    "Share of the denoising steps that the clip of `cutout` stands in for, rounded up to whole steps: sampling begins "
    "later, from that clip with noise. 0 does without it; at 1 the clip is that of `cutout`."
)
OBJECT = (
    "Share of the steps until which what moves is put back as it is in the clip of `cutout`. From `coarse_strength` on "
    "it counts; the larger, the closer to its path, and the stiffer."
)


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
    coarse_strength: float = Field(default=0.0, ge=0, le=1, description=COARSE)
    object_strength: float = Field(default=0.0, ge=0, le=1, description=OBJECT)

    @property
    def first_step(self) -> int:
        """The step that sampling begins with, where there is a coarse clip."""
        return self._steps(self.coarse_strength)

    @property
    def held_steps(self) -> int:
        """How many steps what moves is kept as in the coarse clip."""
        return max(self.first_step, self._steps(self.object_strength))

    def _steps(self, strength: float) -> int:
        """All of them only at 1: with few steps, too, the model has the last word."""
        return self.steps if strength == 1 else min(math.ceil(strength * self.steps - 1e-6), self.steps - 1)

    @property
    def is_guided(self) -> bool:
        """Whether each step takes a second, unconditional pass."""
        return self.guidance_scale != 1


class Acceleration(Record):
    """How the model is run. Each option says what it gains, what it costs, and whether it changes the frames."""

    attention: str = Field(
        default="native",
        description="Attention backend, by its name in diffusers. native is PyTorch's own and needs nothing. flash and "
        "_flash_3 (Hopper GPUs only) are exact to rounding, and may be faster; sage computes in 8 bits, faster still, "
        "with small visible differences. Names that end in _hub download their kernel from the Hugging Face hub at "
        "start, with the package kernels.",
    )
    compile: Literal["none", "regional"] = Field(
        default="none",
        description="regional compiles the transformer's block once for all of its layers; the same to rounding. The "
        "first clips of new shapes wait for the compiler.",
    )
    cache: Literal["none", "first-block"] = Field(
        default="none",
        description="Skips the transformer in steps that would change little, and so changes the frames. first-block "
        "runs the first layer of every step and skips the others if its output changed by less than `cache_threshold`; "
        "it keeps one to three copies of the hidden states per guidance branch. Of no use with few, distilled steps.",
    )
    cache_threshold: float = Field(
        default=0.05,
        ge=0,
        description="Relative change of the first layer. 0 skips nothing; the larger, the faster and the worse.",
    )
    fp8: Literal["none", "stored", "stored-dynamic", "weights", "dynamic"] = Field(
        default="none",
        description="Stores the linear layers of the transformer's blocks as float8, half of bfloat16's memory; norms, "
        "embeddings and the last layer stay as they are. stored keeps the float8 of a checkpoint that has it, value by "
        "value; weights and dynamic round, and so change the frames slightly. stored and weights compute in the "
        "model's precision, slower than none; dynamic and stored-dynamic also compute in float8, and are faster where "
        "compiled.",
    )
    offload: Literal["none", "model", "group"] = Field(
        default="none",
        description="Keeps parts in the CPU's memory; the frames stay the same. model moves one whole part at a time, "
        "which costs seconds per clip. group moves one block while the one before it computes: far less memory, and "
        "little time where the connection is fast; it pins the transformer in the CPU's memory.",
    )
    vae_tiling: bool = Field(
        default=False,
        description="Encodes and decodes in overlapping tiles of 256 px: less memory, more time, and frames that "
        "differ in details, because the first frame is encoded in tiles, too.",
    )
    context_parallel: int = Field(
        default=1,
        ge=1,
        description="GPUs among which the tokens of a pass are split in every layer (Ulysses); the same to rounding. "
        "Each has a process of its own and all weights of the transformer. It must divide the number of attention "
        "heads; where it divides the number of tokens (latent frames x height / 16 x width / 16) it is faster.",
    )
    guidance_parallel: bool = Field(
        default=False,
        description="Twice as many GPUs, in two halves: one computes the guided pass of each step while the other one "
        "computes the unconditional pass; the same frames in about half the time, where steps are guided.",
    )

    @property
    def keeps_float8(self) -> bool:
        """Whether the float8 of a checkpoint stays as it is."""
        return self.fp8 in {"stored", "stored-dynamic"}

    @property
    def ranks(self) -> int:
        """GPUs, and processes, that share a clip."""
        return self.context_parallel * (2 if self.guidance_parallel else 1)


class Profile(Record):
    """One way to run a model."""

    summary: str
    sampling: Sampling
    dtype: Precision = Field(default="bfloat16", description="Of the transformer and the text encoder.")
    vae_dtype: Precision = Field(
        default="float32", description="Of the VAE; bfloat16 decodes in less time, with slightly banded gradients."
    )
    acceleration: Acceleration = Acceleration()
    lora: str | None = Field(
        default=None,
        description="Which of the manifest's sources is a LoRA, which is added to the transformer's weights.",
    )


def profile_of(manifest: Manifest, name: str) -> Profile:
    """The manifest's profile of that name. Raises `GeneratorUnavailable` naming those that it has."""
    if name not in manifest.profiles:
        raise GeneratorUnavailable(
            f"'{manifest.name}' has no profile '{name}'. It has: {', '.join(manifest.profiles)}. Set COW_PROFILE."
        )
    return Profile.model_validate(manifest.profiles[name])


class WanOptions(BaseModel):
    """What `generator_options` may hold for a video model. What is not given is as the profile says."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    steps: int | None = Field(default=None, ge=1, le=200, description="Denoising steps.")
    shift: float | None = Field(default=None, gt=0, le=50, description="Shift of the noise schedule.")
    guidance_scale: float | None = Field(default=None, ge=0, le=30, description="1 does without guidance.")
    coarse_strength: float | None = Field(default=None, ge=0, le=1, description=COARSE)
    object_strength: float | None = Field(default=None, ge=0, le=1, description=OBJECT)
    prompt: str | None = Field(default=None, max_length=4000, description="By default what happens in the clip.")
    negative_prompt: str | None = Field(default=None, max_length=4000, description="By default that of the model.")
    clean_cues: bool = Field(default=True, description="Remove drawn arrows and boxes from the first frame.")


class WanLimits:
    """Options and lengths of a clip."""

    options_model = WanOptions

    def nearest_lengths(self, num_frames: int, fps: float) -> tuple[int, ...]:
        """Any that lasts no longer than the models' longest clip: the model's own has another rate and length."""
        return (min(num_frames, math.floor(LONGEST_SECONDS * fps + 1e-6) + 1),)
