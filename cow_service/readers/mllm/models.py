"""The multimodal LLM of the settings: its manifest and family, and a client model of pydantic-ai to call it with."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from inspect import signature
from typing import Any

from openai import AsyncAzureOpenAI, AsyncOpenAI
from pydantic_ai.exceptions import UserError
from pydantic_ai.models import Model, create_async_http_client, create_async_httpx2_client, infer_model
from pydantic_ai.models.openai import OpenAIChatModel
from pydantic_ai.profiles.openai import OpenAIModelProfile
from pydantic_ai.providers import infer_provider_class
from pydantic_ai.providers.openai_compatible import OpenAICompatibleProvider

from cow_service.errors import ReaderUnavailable
from cow_service.net import limit_replies
from cow_service.readers.chat import Upstream
from cow_service.readers.mllm.known import resolve_model
from cow_service.records import ServerCapabilities
from cow_service.settings import Settings
from cow_service.weights.manifests import Family, Manifest

NO_KEY = "none"  # what stands for a key where a client library wants one
OWN_PROTOCOL = ("anthropic", "google", "google-gla")  # these speak their own protocol at a base URL, too


@dataclass(frozen=True)
class ConfiguredModel:
    """A model that can be called, and what is known about it."""

    model: Model
    name: str  # as it is served
    manifest: Manifest
    family: Family
    deterministic: bool = False  # temperature 0 gives the same reply each time: no provider promises that
    upstream: Upstream | None = None  # the OpenAI-compatible server; None for another protocol
    server: str = "local"  # its address, its provider's name, or that it runs in this process
    key: str | None = field(default=None, repr=False)  # that it is called with
    http: Any = None  # the client of httpx or httpx2 that it is called through, to be closed after use
    # The model for what its server takes; None: pydantic-ai knows that.
    variant: Callable[[ServerCapabilities], Model] | None = None

    @property
    def first(self) -> ServerCapabilities:
        """What is taken for granted before the server has refused anything."""
        has_schema = bool(self.model.profile.get("supports_json_schema_output", False))
        return ServerCapabilities(output="json_schema" if has_schema else "prompt")


def configure(settings: Settings) -> ConfiguredModel:
    """The model of the settings, ready to be called; nothing is sent. Raises `ReaderUnavailable`."""
    resolved, base_url = resolve_model(settings), settings.mllm_base_url
    manifest, family, provider, name = resolved.manifest, resolved.family, resolved.provider, resolved.name
    key = None if settings.mllm_api_key is None else settings.mllm_api_key.get_secret_value()

    # Any server of OpenAI's protocol.
    if base_url is not None and provider not in OWN_PROTOCOL:
        http = limit_replies(create_async_httpx2_client())
        server = OpenAICompatibleProvider("mllm", base_url=base_url, api_key=key or NO_KEY, http_client=http)

        def variant(takes: ServerCapabilities) -> Model:
            profile = OpenAIModelProfile(
                supports_json_schema_output=True,
                supports_json_object_output=True,
                openai_chat_supports_max_completion_tokens=takes.token_field == "max_completion_tokens",
                openai_system_prompt_role="system" if takes.system_role else "user",
            )
            return OpenAIChatModel(name, provider=server, profile=profile)

        upstream, model = Upstream(base_url.rstrip("/"), name, key), variant(ServerCapabilities())
        made = ConfiguredModel(model, name, manifest, family, upstream=upstream, server=resolved.server, key=key)
        return replace(made, http=http, variant=variant)

    # A provider, of whatever protocol.
    if provider is None:
        raise ReaderUnavailable(
            f"COW_MLLM={settings.mllm!r} is served by no provider: set COW_MLLM_BASE_URL to the server that serves it "
            "(vLLM, SGLang, Ollama...), or COW_READER=local to run it in this process."
        )
    try:
        model, http = _model_of(provider, name, base_url, key)
    except (ReaderUnavailable, UserError, ValueError, ImportError) as error:
        reason = str(error).splitlines()[0]
        raise ReaderUnavailable(f"COW_MLLM={settings.mllm!r} cannot be used: {reason}") from error
    client, upstream = getattr(model, "client", None), None
    if isinstance(client, AsyncOpenAI) and not isinstance(client, AsyncAzureOpenAI):  # whose addresses are its own
        key = None if client.api_key in ("", NO_KEY) else client.api_key
        upstream = Upstream(str(client.base_url).rstrip("/"), name, key)
    key = getattr(client, "api_key", None) or key
    made = ConfiguredModel(model, name, manifest, family, upstream=upstream, server=resolved.server, key=key)
    return replace(made, http=http)


def _model_of(name: str, model: str, base_url: str | None, key: str | None) -> tuple[Model, Any]:
    """A provider's model, and its HTTP client; what is not given comes from the provider's own variables.

    Raises `ReaderUnavailable`, and `UserError`, `ValueError` and `ImportError` of pydantic-ai.
    """
    try:
        provider_class = infer_provider_class(name)
    except ValueError as error:
        known = "Take openai, anthropic, google, mistral, groq, openrouter..."
        raise ReaderUnavailable(f"there is no provider {name!r}. {known}") from error
    given: dict[str, Any] = {"base_url": base_url, "api_key": key}
    if takes := signature(provider_class).parameters.get("http_client"):  # else its library has no such client
        is_httpx = str(takes.annotation).startswith("httpx.")
        given["http_client"] = limit_replies(create_async_http_client() if is_httpx else create_async_httpx2_client())
    try:
        provider = provider_class(**{field: value for field, value in given.items() if value is not None})
    except UserError as error:
        if key is not None:
            raise
        raise ReaderUnavailable("it needs a key: set COW_MLLM_API_KEY, or the provider's own variable.") from error
    return infer_model(f"{name}:{model}", provider_factory=lambda _: provider), given.get("http_client")
