"""Settings of the service, from the environment: each `COW_` plus the field's name in capitals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from platformdirs import user_data_path
from pydantic import Field, SecretStr, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict
from pydantic_settings import SettingsError as UnreadableSetting


class SettingsError(Exception):
    """A setting has a value that cannot be used. The message names each one and what it takes."""


class Settings(BaseSettings):
    """What a server or a command line run may be told."""

    model_config = SettingsConfigDict(env_prefix="COW_", env_ignore_empty=True, frozen=True, extra="ignore")

    data_dir: Path = Field(
        default_factory=lambda: user_data_path("cow", appauthor=False),
        description="Folder for artifacts; made if missing.",
    )
    host: str = Field(default="127.0.0.1", description="Address the server listens on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port the server listens on; 0 takes a free one.")
    mllm: str | None = Field(
        default=None, min_length=1, description="Multimodal LLM to ask: a manifest's name, or provider:model."
    )
    mllm_base_url: str | None = Field(
        default=None, pattern=r"^https?://", description="Address of the server that serves it, OpenAI-compatible."
    )
    mllm_api_key: SecretStr | None = Field(
        default=None, description="Its key; by default that of the provider's own environment variable."
    )
    mllm_model: str | None = Field(
        default=None, min_length=1, description="Name under which it is served, where that is not the manifest's."
    )
    mllm_timeout: float = Field(
        default=60, gt=0, le=3600, allow_inf_nan=False, description="Longest wait for one reply, seconds."
    )
    mllm_budget: float = Field(
        default=180, gt=0, le=7200, allow_inf_nan=False, description="Longest wait with all retries, seconds."
    )
    mllm_concurrency: int = Field(default=8, ge=1, le=1024, description="Calls of it at the same time; others wait.")
    reader: str = Field(
        default_factory=lambda told: "mllm" if told.get("mllm") else "embedded",
        description="Reader where a request names none; `mllm` where COW_MLLM is set.",
    )
    generator: str = Field(default="cutout", description="Generator where a request names none.")
    max_image_megapixels: float = Field(
        default=25, gt=0, le=500, allow_inf_nan=False, description="Largest image taken, in millions of pixels."
    )
    max_body_mb: float = Field(
        default=32, gt=0, le=4096, allow_inf_nan=False, description="Largest request body taken, in MB (10^6 bytes)."
    )
    models_dir: Path | None = Field(
        default=None, description="Folder for weights; by default the folder `models` of the data folder."
    )
    checkpoints: dict[str, Path] = Field(
        default_factory=dict,
        description="Checkpoints of your own (a folder, or one safetensors file of a transformer) to use instead of "
        "what `cow models pull` brings, by name of the generator or multimodal LLM, as JSON.",
    )
    profile: str = Field(default="exact", description="How video models run: a profile of their manifest.")
    device: str = Field(
        default="auto",
        pattern=r"^(auto|cpu|cuda(:\d+)?)$",
        description="Where models run: cpu, cuda, cuda:1...; auto takes the first GPU, else the CPU.",
    )
    concurrency: int = Field(default=2, ge=1, le=256, description="Requests computed at the same time; others wait.")

    @property
    def weights_dir(self) -> Path:
        """Folder for weights."""
        return self.models_dir or self.data_dir / "models"

    def has(self, name: str) -> bool:
        """Whether a setting, by its name in the environment (COW_...), is set."""
        return getattr(self, name.removeprefix("COW_").lower()) is not None

    def own_parts(self, name: str) -> tuple[str, ...]:
        """Parts of a model that come from a checkpoint of one's own, and need not be pulled."""
        checkpoint = self.checkpoints.get(name)
        if checkpoint is None or not checkpoint.exists():
            return ()
        return ("transformer", "base") if (checkpoint / "vae").is_dir() else ("transformer",)


def _told(item: Any) -> str:
    """One bad setting. A key or an address may hold a secret, and is not repeated."""
    name = str(item["loc"][0])
    if name == "mllm_base_url":
        return "COW_MLLM_BASE_URL must begin with http:// or https://"
    return f"COW_{name.upper()}={item['input']!r}: {item['msg']}"


def load_settings(**overrides: Any) -> Settings:
    """Settings from the environment, with overrides that are not None. Raises `SettingsError` for a bad value."""
    try:
        return Settings(**{name: value for name, value in overrides.items() if value is not None})
    except UnreadableSetting as error:
        field = str(error).split('"')[1:2]
        raise SettingsError(f"Bad settings: COW_{''.join(field).upper()} is not JSON.") from error
    except ValidationError as error:
        told = "; ".join(_told(item) for item in error.errors() if item["type"] != "default_factory_not_called")
        raise SettingsError(f"Bad settings: {told}.") from error
