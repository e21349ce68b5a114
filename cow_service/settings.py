"""Settings of the service, from the environment: each `COW_` plus the field's name in capitals."""

import base64
import os
import re
import sys
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from platformdirs import user_data_path
from pydantic import Field, SecretStr, ValidationError, ValidationInfo, field_validator
from pydantic_core import to_json
from pydantic_settings import BaseSettings, SettingsConfigDict
from pydantic_settings import SettingsError as UnreadableSetting

KEY_NAME = r"^[A-Za-z0-9._-]{1,64}$"
KEY_HASH = r"^sha256:[0-9a-f]{64}$"
SECRET_BYTES = range(24, 65)  # as Standard Webhooks says
MAX_SECRETS = 2  # that sign at the same time, while one takes over from the other
# Without a name or a password before the bucket: they would be kept in the job database.
OBJECT_STORE = re.compile(r"(s3|gs|az)://[A-Za-z0-9][A-Za-z0-9._-]*(/[A-Za-z0-9._-]+)*/?")
ORIGIN = r"^(\*|[a-z][a-z0-9+.-]*://[^/\s?#@A-Z]+)$"  # as browsers write it: lower case, no path


MAX_WORKERS = 256
WORKER_BYTES = 400e6  # of memory for each process that computes


def usable_cores() -> int:
    """How many processes may compute at the same time: one per core that this one may use, as far as memory allows."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # of a container, where there is one: "max" is none
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        cores = min(cores, max(1, round(float(quota) / float(period))))
    return max(1, min(cores, int(usable_memory() / 2 / WORKER_BYTES), MAX_WORKERS))


def usable_memory() -> float:
    """Bytes of memory that all processes here may take: the machine's, or those of the container."""
    import psutil  # noqa: PLC0415 # the command line's help does without it

    memory = float(psutil.virtual_memory().total)
    with suppress(OSError, ValueError):
        memory = min(memory, float(Path("/sys/fs/cgroup/memory.max").read_text()))
    return memory


class SettingsError(Exception):
    """A setting has a value that cannot be used. The message names each one and what it takes."""


class Settings(BaseSettings):
    """The settings of a server or of a command line run."""

    model_config = SettingsConfigDict(
        env_prefix="COW_",
        env_ignore_empty=True,
        frozen=True,
        extra="ignore",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    data_dir: Path = Field(default_factory=lambda: user_data_path("cow", appauthor=False))
    """Folder for artifacts, the job database and temporary files, made if missing; by default the user's own."""
    artifacts: str | None = Field(default=None, min_length=1)
    """Where artifacts are kept: a folder, or s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX; by
    default the folder `artifacts` of the data folder."""
    artifacts_redirect: bool = True
    """Whether callers are sent to the object store for artifacts, by signed URLs; if not, the server passes the bytes
    on."""
    artifacts_max_gb: float | None = Field(default=None, gt=0)
    """Artifacts that are kept, in GB (10^9 bytes): beyond, those that no job used for longest are removed; by default
    age alone decides."""
    host: str = "127.0.0.1"
    """Address the server listens on."""
    port: int = Field(default=8000, ge=0, le=65535)
    """Port the server listens on; 0 takes a free one."""
    mllm: str | None = Field(default=None, min_length=1)
    """Multimodal LLM to ask: a manifest's name, or provider:model."""
    mllm_base_url: str | None = Field(default=None, pattern=r"^https?://")
    """Address of the server that serves it, OpenAI-compatible."""
    mllm_api_key: SecretStr | None = None
    """Its key; by default that of the provider's own environment variable."""
    mllm_model: str | None = Field(default=None, min_length=1)
    """Name under which it is served, where that is not the manifest's."""
    mllm_timeout: float = Field(default=60, gt=0, le=3600)
    """Longest wait for one reply, seconds."""
    mllm_budget: float = Field(default=180, gt=0, le=7200)
    """Longest wait with all retries, seconds."""
    mllm_concurrency: int = Field(default=64, ge=1, le=1024)
    """Most calls of it at the same time: there are as many as it takes without refusals and longer waits."""
    reader: str = Field(default_factory=lambda values: "mllm" if values.get("mllm") else "embedded")
    """Reader where a request names none; `mllm` where COW_MLLM is set."""
    generator: str = "cutout"
    """Generator where a request names none."""
    perception: str = Field(default="none", min_length=1)
    """Models that see: none, cpu, gpu, or names that `cow models` lists, one of each kind, with commas between."""
    max_image_megapixels: float = Field(default=25, gt=0, le=500)
    """Largest image taken, in millions of pixels."""
    max_body_mb: float = Field(default=32, gt=0, le=4096)
    """Largest request body taken, in MB (10^6 bytes)."""
    max_bodies_mb: float = Field(default=256, gt=0, le=65536)
    """Request bodies that are held at the same time, in MB; more are refused with 503."""
    allow_image_urls: tuple[str, ...] = ()
    """Hosts from which images given by URL are fetched, as JSON: names, name:port, *.name for all below it, * for every
    public host; none by default."""
    body_timeout: float = Field(default=30, gt=0, le=3600)
    """Longest wait for a whole request body, seconds."""
    models_dir: Path | None = None
    """Folder for weights; by default the folder `models` of the data folder."""
    checkpoints: dict[str, Path] = Field(default_factory=dict)
    """Checkpoints of your own (a folder, or one safetensors file of a transformer) to use instead of what `cow models
    pull` brings, by name of the generator or multimodal LLM, as JSON."""
    profile: str = "exact"
    """How video models run: a profile of their manifest."""
    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$")
    """Where models run: cpu, cuda, cuda:1...; auto takes the first GPU, else the CPU."""
    concurrency: int = Field(default_factory=usable_cores, ge=1, le=MAX_WORKERS)
    """Requests computed at the same time; others wait. By default one per CPU core, as memory allows."""
    workers: bool = True
    """Compute in processes of their own, one per request at a time; 0: in that of the server, where a crash ends every
    job and Python computes one at a time."""
    role: Literal["all", "api"] = "all"
    """What a server does: api takes requests and computes nothing, for which `cow worker` runs beside it on the same
    job database; all does both."""
    metrics_port: int | None = Field(default=None, ge=1, le=65535)
    """Port on which `cow worker` serves its metrics, at the address of COW_HOST; by default none. Servers have GET
    /metrics."""
    queues: tuple[str, ...] = ()
    """Queues from which jobs are taken, as JSON: light, and the name of each backend with a device of its own, such as
    ati; by default all."""
    worker_memory_mb: float | None = Field(default=None, gt=0)
    """Memory that one worker process may take, MB; its job fails with worker-ended beyond that. By default 80% of the
    machine's."""
    worker_jobs: int = Field(default=1000, ge=1)
    """Jobs after which a worker process is replaced by a new one."""
    load_timeout: float = Field(default=600, gt=0, le=86_400)
    """Seconds that a worker process may take to start and to load its backends; beyond that it is ended, and started
    again."""
    warmup: bool = True
    """Compute something small before /readyz says ready, and compile a video model for clips of any size when it is
    loaded; else the first requests take several times as long."""
    job_timeout: float = Field(default=3600, gt=0, le=604_800)
    """Seconds that one job may compute in a worker process; beyond that it fails with job-timeout."""
    generator_concurrency: dict[str, Annotated[int, Field(ge=1, le=256)]] = Field(default_factory=dict)
    """Clips that a generator makes at the same time, by its name, as JSON; by default 1 of a video model, and of others
    as many as COW_CONCURRENCY."""
    api_keys: dict[Annotated[str, Field(pattern=KEY_NAME)], Annotated[str, Field(pattern=KEY_HASH)]] = Field(
        default_factory=dict
    )
    """Who may call, as JSON: name to the hash of its key, as `cow keys new NAME` prints them; by default whoever
    reaches the server."""
    admin_keys: tuple[str, ...] = ()
    """Names of COW_API_KEYS whose holders administer the server, as JSON: GET /workers tells only them hosts, process
    ids and ids of jobs; everybody where there are no keys."""
    rate_limit: int | None = Field(default=None, ge=1, le=1_000_000)
    """Requests a minute with one key, or from one address where there are no keys."""
    rate_limit_mb: float | None = Field(default=None, gt=0, le=1_000_000)
    """Request bodies, and images fetched by URL, in MB a minute, likewise; refused requests count, too."""
    rate_limit_cpu: float | None = Field(default=None, gt=0, le=60_000)
    """Seconds of CPU that reading these may take in a minute, likewise; refused requests count, too."""
    cors_origins: tuple[Annotated[str, Field(pattern=ORIGIN)], ...] = ()
    """Origins of web pages that may use the server, as JSON, such as https://app.example.org; * for all of them where
    keys are set."""
    log_format: Literal["text", "json"] = "text"
    """How the server's logs are written."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """The least important messages that the server logs."""
    database_url: SecretStr | None = None
    """Job database: sqlite:///FILE or postgresql://USER:PASSWORD@HOST/NAME; by default a file in the data folder."""
    migrate: bool = True
    """Create and update the tables of the job database at the start; false where `cow migrate` does so before, with
    rights that servers and workers need not have."""
    queue_limit: int = Field(default=1000, ge=1, le=1_000_000)
    """Jobs that wait or run; more are refused with queue-full."""
    queue_limit_per_key: int | None = Field(default=None, ge=1, le=1_000_000)
    """Of them, those of one key; by default half of them where there are several keys."""
    running_limit_per_key: int | None = Field(default=None, ge=1, le=1_000_000)
    """Jobs of one key that are computed at the same time, in all processes together; to be set for workers, too. By
    default as many as there are places."""
    key_weights: dict[str, Annotated[float, Field(ge=0.01, le=100)]] = Field(default_factory=dict)
    """Shares of keys while several have jobs that wait, by their names, as JSON; by default 1 for each."""
    job_retention_hours: float = Field(default=168, gt=0, le=87_600)
    """Age at which finished jobs are removed, hours."""
    shutdown_grace: float = Field(default=10, ge=0, le=3600)
    """Seconds that running jobs are given when the server stops; what is not done then goes on at the next start."""
    outage_budget: float = Field(default=600, ge=0, le=86400)
    """Seconds that a running job waits for a database or a disk that is away, before it fails."""
    webhook_secret: SecretStr | None = None
    """Secret that signs webhooks (Standard Webhooks, whsec_...); without it none are called. Two with a space between
    them both sign: the new one and the old one, until every receiver knows the new one."""

    @field_validator("artifacts")
    @classmethod
    def _is_place(cls, place: str | None) -> str | None:
        if place is not None and "://" in place and OBJECT_STORE.fullmatch(place) is None:
            raise ValueError("neither a folder nor an object store")
        return place

    @field_validator("api_keys")
    @classmethod
    def _different(cls, hashes: dict[str, str]) -> dict[str, str]:
        if len(set(hashes.values())) < len(hashes):
            raise ValueError("two names have the same key")
        return hashes

    @field_validator("key_weights", "admin_keys")
    @classmethod
    def _of_keys(cls, names: Collection[str], info: ValidationInfo) -> Collection[str]:
        unknown = set(names) - info.data.get("api_keys", {}).keys()
        if unknown:
            raise ValueError(f"{min(unknown)[:64]!r} is no name of COW_API_KEYS: `cow keys new` makes one")
        return names

    @field_validator("cors_origins")
    @classmethod
    def _not_everybody(cls, origins: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        if "*" in origins and not info.data.get("api_keys"):
            raise ValueError("* would let every web page use a server without keys; set COW_API_KEYS")
        return origins

    @field_validator("webhook_secret")
    @classmethod
    def _signs(cls, secret: SecretStr | None) -> SecretStr | None:
        each = [] if secret is None else secret.get_secret_value().split(" ")
        for text in each:
            begin, _, coded = text.partition("_")
            size = len(base64.b64decode(coded, validate=True))  # or a ValueError
            if begin != "whsec" or size not in SECRET_BYTES or len(each) > MAX_SECRETS:
                raise ValueError("not whsec_ and base64 of 24 to 64 bytes")
        return secret

    def is_admin(self, owner: str | None) -> bool:
        """Whether the owner of a key administers the server; None: there are no keys."""
        return owner is None or owner in self.admin_keys

    @property
    def own_queue_limit(self) -> int:
        """Jobs of one key that wait or run."""
        shared = max(1, self.queue_limit // 2) if len(self.api_keys) > 1 else self.queue_limit
        return min(self.queue_limit, self.queue_limit_per_key or shared)

    @property
    def weights_dir(self) -> Path:
        """Folder for weights."""
        return self.models_dir or self.data_dir / "models"

    def dump_secrets(self) -> str:
        """All settings as JSON, secrets too, for a process of this server: `Settings.model_validate_json` reads it."""
        values = {name: value.get_secret_value() if isinstance(value, SecretStr) else value for name, value in self}
        return to_json(values).decode()

    def has(self, name: str) -> bool:
        """Whether a setting, by its name in the environment (COW_...), is set."""
        return getattr(self, name.removeprefix("COW_").lower()) is not None

    def own_parts(self, name: str) -> tuple[str, ...]:
        """Parts of a model that come from a checkpoint of one's own, and need not be pulled."""
        checkpoint = self.checkpoints.get(name)
        if checkpoint is None or not checkpoint.exists():
            return ()
        return ("transformer", "base") if (checkpoint / "vae").is_dir() else ("transformer",)


# Messages about settings that may hold a secret, whose value is not repeated.
SECRET_SETTINGS = {
    "mllm_base_url": "must begin with http:// or https://",
    "artifacts": "must be a folder, or s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX, without "
    "credentials: those come from variables of their own, such as AWS_*",
    "webhook_secret": "must be whsec_ and the base64 of 24 to 64 random bytes, or two of them",
    "api_keys": 'must be a JSON object of names (1 to 64 of A-Z, a-z, 0-9, ".", "_", "-") and hashes ("sha256:" and 64 '
    "hexadecimal digits), a different one for each; it takes no plain keys. `cow keys new NAME` makes both",
}


def load_settings(**overrides: Any) -> Settings:
    """Settings from the environment, with overrides that are not None. Raises `SettingsError` for a bad value."""
    try:
        return Settings(**{name: value for name, value in overrides.items() if value is not None})
    except UnreadableSetting as error:
        field = str(error).split('"')[1:2]
        raise SettingsError(f"Bad settings: COW_{''.join(field).upper()} is not JSON.") from error
    except ValidationError as error:
        messages: list[str] = []
        for item in error.errors():
            name = str(item["loc"][0])
            if name in SECRET_SETTINGS:
                messages.append(f"COW_{name.upper()} {SECRET_SETTINGS[name]}")
            elif item["type"] != "default_factory_not_called":
                reason = item["msg"].removeprefix("Value error, ")
                messages.append(f"COW_{name.upper()}={item['input']!r}: {reason}")
        raise SettingsError(f"Bad settings: {'; '.join(messages)}.") from error
