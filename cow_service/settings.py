"""Settings of the service, read from environment variables: `COW_` plus the field's name in capitals."""

import base64
import difflib
import os
import re
import sys
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from platformdirs import user_data_path
from pydantic import Field, SecretStr, ValidationError, ValidationInfo, field_validator
from pydantic_core import to_json
from pydantic_settings import BaseSettings, SettingsConfigDict
from pydantic_settings import SettingsError as UnreadableSetting

KEY_NAME = r"^[A-Za-z0-9._-]{1,64}$"
KEY_HASH = r"^sha256:[0-9a-f]{64}$"
SECRET_BYTES = range(24, 65)  # as Standard Webhooks says
MAX_SECRETS = 2  # that sign at the same time, while a new secret replaces an old one
# Without user name or password: they would be kept in the job database.
OBJECT_STORE = re.compile(r"(s3|gs|az)://[A-Za-z0-9][A-Za-z0-9._-]*(/[A-Za-z0-9._-]+)*/?")
ORIGIN = r"^(\*|[a-z][a-z0-9+.-]*://[^/\s?#@A-Z]+)$"  # as browsers write it: lower case, no path
MAX_WORKERS = 256
MIN_MEMORY_MB = 600  # for a server and one worker process
WORKER_BYTES = 400e6  # of memory for each process that computes: 190 MB without a job, and what encodes a clip
SHARE_OF_MEMORY = 0.8  # of the machine's, that a server may take


def usable_cores() -> int:
    """How many processes may compute at the same time: one per available core, as far as memory allows."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # the limit of a container; "max" means none
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        cores = min(cores, max(1, round(float(quota) / float(period))))
    return max(1, min(cores, int(usable_memory() / 2 / WORKER_BYTES), MAX_WORKERS))


def usable_memory() -> float:
    """Bytes of memory that all processes may use together: the machine's, or the container's."""
    import psutil  # noqa: PLC0415 # keeps the command line's help quick

    memory = float(psutil.virtual_memory().total)
    with suppress(OSError, ValueError):
        memory = min(memory, float(Path("/sys/fs/cgroup/memory.max").read_text()))
    return memory


class SettingsError(Exception):
    """A setting has an unusable value. The message names each such setting and what it takes."""


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
    """Folder for artifacts, the job database and temporary files; created if missing."""
    artifacts: str | None = Field(default=None, min_length=1)
    """Where images, frames and videos are kept: a folder, or s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or
    az://CONTAINER/PREFIX; by default the folder `artifacts` in the data folder."""
    artifacts_redirect: bool = True
    """Redirect callers to signed URLs of the object store for artifacts; otherwise the server sends the bytes."""
    artifacts_max_gb: float | None = Field(default=None, gt=0)
    """Most GB (10^9 bytes) of artifacts; beyond, the least recently used are removed. By default only age decides."""
    host: str = "127.0.0.1"
    """Address the server listens on."""
    port: int = Field(default=8000, ge=0, le=65535)
    """Port the server listens on; 0 takes a free one."""
    mllm: str | None = Field(default=None, min_length=1)
    """Multimodal LLM to use: the name of a manifest, or provider:model."""
    mllm_base_url: str | None = Field(default=None, pattern=r"^https?://")
    """URL of the OpenAI-compatible server of the multimodal LLM."""
    mllm_api_key: SecretStr | None = None
    """API key of the multimodal LLM; by default from the provider's own environment variable."""
    mllm_model: str | None = Field(default=None, min_length=1)
    """Name of the multimodal LLM on its server, if different from the manifest's."""
    mllm_timeout: float = Field(default=60, gt=0, le=3600)
    """Longest wait for one reply of the multimodal LLM, seconds."""
    mllm_budget: float = Field(default=180, gt=0, le=7200)
    """Longest wait for the multimodal LLM including retries, seconds."""
    mllm_concurrency: int = Field(default=64, ge=1, le=1024)
    """Most simultaneous calls of the multimodal LLM; lowered while it refuses calls."""
    chat_fields: str = Field(default="", pattern=r"^[\w, -]*$")
    """Fields of /v1 chats that the multimodal LLM's server is sent besides OpenAI's own, comma-separated, such as
    top_k, enable_thinking; every caller may set them."""
    reader: str = Field(default_factory=lambda values: "mllm" if values.get("mllm") else "embedded")
    """Default reader, the part that understands the question; `mllm` where COW_MLLM is set."""
    generator: str = "cutout"
    """Default generator, the part that makes the frames."""
    perception: str = Field(default="eye", min_length=1)
    """Vision models: eye, cpu, gpu, or comma-separated names of `cow models`, at most one of each kind. The small
    network `eye` sees beside all of them; none, alone, turns it off."""
    max_image_megapixels: float = Field(default=25, gt=0, le=500)
    """Largest image accepted, in millions of pixels."""
    max_body_mb: float = Field(default=32, gt=0, le=4096)
    """Largest request body accepted, in MB (10^6 bytes)."""
    max_bodies_mb: float = Field(default=256, gt=0, le=65536)
    """Most MB of request bodies held at the same time; further requests are refused with 503."""
    allow_image_urls: tuple[str, ...] = ()
    """Hosts that images may be fetched from, and that videos and sounds of chats may have in their URLs, as JSON: name,
    name:port, *.name for its subdomains, * for every public host; by default none."""
    body_timeout: float = Field(default=30, gt=0, le=3600)
    """Longest wait for a whole request body, seconds."""
    models_dir: Path | None = None
    """Folder for model weights; by default the folder `models` in the data folder."""
    checkpoints: dict[str, Path] = Field(default_factory=dict)
    """Your own checkpoints to use instead of pulled weights, as JSON: name of the generator or multimodal LLM to a
    folder, or to one safetensors file of a transformer."""
    profile: str = "exact"
    """How video models run: a profile of their manifest."""
    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$")
    """Where models run: cpu, cuda, cuda:1...; auto uses the first GPU, else the CPU."""
    concurrency: int = Field(default_factory=usable_cores, ge=1, le=MAX_WORKERS)
    """Requests computed at the same time; others wait. By default one per CPU core, as memory allows."""
    workers: bool = True
    """Compute in separate worker processes; 0: in the server's own process, where a crash ends every job and only one
    job computes at a time."""
    ray: str | None = Field(default=None, pattern=r"^(auto|[A-Za-z0-9._-]+:\d{1,5})$")
    """Compute on a Ray cluster: auto, or HOST:PORT of its head. This machine must be one of its nodes. By default jobs
    are computed by worker processes of this machine."""
    ray_actors: dict[str, tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1, le=MAX_WORKERS)]]] = Field(
        default_factory=dict
    )
    """Fewest and most Ray actors of a queue, as JSON: name to [fewest, most]; by default from 1 (default queues) or 0
    to as many as the nodes have room for. Where nodes come and go as needed, set the most."""
    role: Literal["all", "api"] = "all"
    """What a server does: all accepts requests and computes them; api only accepts them, and needs `cow worker` on the
    same job database."""
    metrics_port: int | None = Field(default=None, ge=1, le=65535)
    """Port for the metrics of `cow worker`, at COW_HOST; by default none. Servers have GET /metrics."""
    memory_mb: float | None = Field(default=None, ge=MIN_MEMORY_MB)
    """Most MB of memory for the server and its worker processes together; a job waits until what it will need is free.
    By default 80% of what the machine, or the container, has."""
    worker_memory_mb: float | None = Field(default=None, gt=0)
    """Most MB of memory for one worker process, beyond which its job fails with worker-ended; by default only
    COW_MEMORY_MB limits it."""
    worker_jobs: int = Field(default=1000, ge=1)
    """Number of jobs after which a worker process is replaced."""
    load_timeout: float = Field(default=600, gt=0, le=86_400)
    """Longest time for a worker process to start and load its backends, seconds; then it is restarted."""
    warmup: bool = True
    """Run a tiny simulation before /readyz says ready, and compile video models when they are loaded, so that the first
    requests are fast."""
    job_timeout: float = Field(default=3600, gt=0, le=604_800)
    """Longest computing time of one job, seconds; then it fails with job-timeout."""
    generator_concurrency: dict[str, Annotated[int, Field(ge=1, le=256)]] = Field(default_factory=dict)
    """Clips that a generator makes at the same time, as JSON: name to number; by default 1 for video models, and
    COW_CONCURRENCY for others."""
    api_keys: dict[Annotated[str, Field(pattern=KEY_NAME)], Annotated[str, Field(pattern=KEY_HASH)]] = Field(
        default_factory=dict
    )
    """API keys, as JSON: name to hash of the key, as `cow keys new NAME` prints them; by default no key is needed."""
    admin_keys: tuple[str, ...] = ()
    """Names in COW_API_KEYS that may see hosts, process ids and job ids in GET /workers, as JSON; without API keys
    everyone may."""
    rate_limit: int | None = Field(default=None, ge=1, le=1_000_000)
    """Most requests per minute for one key, or for one address if there are no keys."""
    rate_limit_mb: float | None = Field(default=None, gt=0, le=1_000_000)
    """Most MB per minute, by key or address, of request bodies and fetched images; refused requests count, too."""
    rate_limit_cpu: float | None = Field(default=None, gt=0, le=60_000)
    """Most CPU seconds per minute, by key or address, for reading bodies and images; refused requests count, too."""
    cors_origins: tuple[Annotated[str, Field(pattern=ORIGIN)], ...] = ()
    """Origins of web pages that may use the server, as JSON, such as https://app.example.org; * for all, if API keys
    are set."""
    log_format: Literal["text", "json"] = "text"
    """Format of the server's logs."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level of log messages."""
    database_url: SecretStr | None = None
    """Job database: sqlite:///FILE or postgresql://USER:PASSWORD@HOST/NAME; by default a file in the data folder."""
    migrate: bool = True
    """Create and update the tables of the job database at start; set to false if you run `cow migrate` before, with
    rights that servers and workers do not need."""
    queue_limit: int = Field(default=1000, ge=1, le=1_000_000)
    """Most jobs that wait or run; further requests are refused with queue-full."""
    queue_limit_per_key: int | None = Field(default=None, ge=1, le=1_000_000)
    """Most jobs of one key that wait or run; by default half of COW_QUEUE_LIMIT if there are several keys."""
    running_limit_per_key: int | None = Field(default=None, ge=1, le=1_000_000)
    """Most jobs of one key that compute at the same time, in all processes; set it for workers, too. By default no
    limit."""
    key_weights: dict[str, Annotated[float, Field(ge=0.01, le=100)]] = Field(default_factory=dict)
    """Shares of keys while several of them have waiting jobs, as JSON: name to weight; by default 1 each."""
    job_retention_hours: float = Field(default=168, gt=0, le=87_600)
    """Age at which finished jobs are removed, hours."""
    shutdown_grace: float = Field(default=10, ge=0, le=3600)
    """Time that running jobs get to finish when the server stops, seconds; the rest continue at the next start."""
    outage_budget: float = Field(default=600, ge=0, le=86400)
    """Longest time that a running job waits for an unavailable database or disk before it fails, seconds."""
    webhook_secret: SecretStr | None = None
    """Secret that signs webhooks (Standard Webhooks, whsec_...); without it none are called. To rotate it, give the new
    and the old one with a space between: both sign."""

    @field_validator("artifacts")
    @classmethod
    def _is_place(cls, place: str | None) -> str | None:
        if place is not None and "://" in place and OBJECT_STORE.fullmatch(place) is None:
            raise ValueError("neither a folder nor an object store")
        return place

    @field_validator("database_url")
    @classmethod
    def _is_database(cls, url: SecretStr | None) -> SecretStr | None:
        parts = urlsplit("" if url is None else url.get_secret_value())
        is_there = parts.hostname is not None or "host=" in parts.query  # a socket, for example
        has_host = is_there and parts.port != 0  # or a ValueError
        known = {"sqlite": parts.path[1:] not in ("", ":memory:"), "postgresql": has_host, "postgres": has_host}
        if url is not None and not known.get(parts.scheme.partition("+")[0]):
            raise ValueError("no database")
        return url

    @field_validator("ray_actors")
    @classmethod
    def _in_order(cls, numbers: dict[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
        if any(fewest > most for fewest, most in numbers.values()):
            raise ValueError("the fewest are more than the most")
        return numbers

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
            raise ValueError(f"{min(unknown)[:64]!r} is not a name in COW_API_KEYS: create it with `cow keys new`")
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
        """Whether the owner of a key administers the server; None: the server has no keys."""
        return owner is None or owner in self.admin_keys

    @property
    def own_queue_limit(self) -> int:
        """Most jobs of one key that wait or run."""
        shared = max(1, self.queue_limit // 2) if len(self.api_keys) > 1 else self.queue_limit
        return min(self.queue_limit, self.queue_limit_per_key or shared)

    @property
    def memory(self) -> float:
        """Most bytes of memory for all processes of this server."""
        return self.memory_mb * 1e6 if self.memory_mb else SHARE_OF_MEMORY * usable_memory()

    @property
    def weights_dir(self) -> Path:
        """Folder for weights."""
        return self.models_dir or self.data_dir / "models"

    def dump_secrets(self) -> str:
        """All settings as JSON, with secrets, for another process of this server (`Settings.model_validate_json`)."""
        values = {name: value.get_secret_value() if isinstance(value, SecretStr) else value for name, value in self}
        return to_json(values).decode()

    def has(self, name: str) -> bool:
        """Whether a setting is set, by its environment variable (COW_...)."""
        return getattr(self, name.removeprefix("COW_").lower()) is not None

    def own_parts(self, name: str) -> tuple[str, ...]:
        """Parts of a model that come from the operator's own checkpoint, and need not be pulled."""
        checkpoint = self.checkpoints.get(name)
        if checkpoint is None or not checkpoint.exists():
            return ()
        return ("transformer", "base") if (checkpoint / "vae").is_dir() else ("transformer",)


# Messages about settings that may hold a secret, or whose pattern says little, without their value.
SETTINGS_IN_WORDS = {
    "ray": "must be auto, or HOST:PORT of the head of a Ray cluster of which this machine is a node, without ray://",
    "ray_actors": 'must be a JSON object of queues and the fewest and most actors of each, such as {"light": [2, 16]}',
    "chat_fields": "must be names with commas between them, such as top_k, enable_thinking",
    "mllm_base_url": "must begin with http:// or https://",
    "artifacts": "must be a folder, or s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX, without "
    "credentials: set these by the provider's own variables, such as AWS_*",
    "database_url": "must be sqlite:///FILE or postgresql://USER:PASSWORD@HOST:PORT/NAME, with a number for a port and "
    "percent signs for special characters, such as %40 for @ and %23 for #",
    "webhook_secret": "must be whsec_ and the base64 of 24 to 64 random bytes, or two of them",
    "api_keys": 'must be a JSON object of names (1 to 64 of A-Z, a-z, 0-9, ".", "_", "-") and hashes ("sha256:" and 64 '
    "hexadecimal digits), a different one for each; it takes no plain keys. `cow keys new NAME` makes both",
}
JSON_EXAMPLES = {  # of settings that are no lists
    "api_keys": '{"alice": "sha256:0123..."}, as `cow keys new alice` prints it',
    "checkpoints": '{"ati": "/models/ati"}', "ray_actors": '{"light": [2, 16]}',
    "generator_concurrency": '{"ati": 2}', "key_weights": '{"alice": 2}',
}  # fmt: skip


def load_settings(**overrides: Any) -> Settings:
    """Settings from the environment, with overrides that are not None. Raises `SettingsError`, naming what is wrong."""
    # A misspelled setting is never passed over: a server might lack the keys that its operator means to have given.
    names = {f"COW_{name.upper()}" for name in Settings.model_fields} | {"COW_BASE_URL", "COW_API_KEY"}  # of clients
    for name in sorted({name.upper() for name in os.environ if name.upper().startswith("COW_")} - names):
        if close := difflib.get_close_matches(name, names, 1, cutoff=0.85):
            raise SettingsError(f"Bad settings: {name} is no setting; {close[0]} is. Correct its name, or remove it.")
    try:
        return Settings(**{name: value for name, value in overrides.items() if value is not None})
    except UnreadableSetting as error:
        field = "".join(str(error).split('"')[1:2])
        example = JSON_EXAMPLES.get(field, '["one", "another"]')
        raise SettingsError(f"Bad settings: COW_{field.upper()} is not JSON such as {example}.") from error
    except ValidationError as error:
        messages: list[str] = []
        for item in error.errors():
            name = str(item["loc"][0])
            if name in SETTINGS_IN_WORDS:
                messages.append(f"COW_{name.upper()} {SETTINGS_IN_WORDS[name]}")
            elif item["type"] != "default_factory_not_called":
                reason = item["msg"].removeprefix("Value error, ")
                messages.append(f"COW_{name.upper()}={item['input']!r}: {reason}")
        raise SettingsError(f"Bad settings: {'; '.join(messages)}.") from error
