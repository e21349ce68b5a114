"""Who serves the multimodal LLM: from the settings to a model that can be asked, and what its family is."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any

from pydantic_ai.exceptions import UserError
from pydantic_ai.models import Model, infer_model
from pydantic_ai.models.openai import OpenAIChatModel
from pydantic_ai.profiles.openai import OpenAIModelProfile
from pydantic_ai.providers import Provider, infer_provider_class
from pydantic_ai.providers.openai_compatible import OpenAICompatibleProvider

from cow_service.errors import ReaderUnavailable
from cow_service.settings import Settings
from cow_service.weights.manifests import Family, Manifest, load_families, load_manifests

UNKNOWN = "generic"  # the manifest for models that no other one describes
OWN_PROTOCOL = ("anthropic", "google", "google-gla")  # these speak their own protocol at a base URL, too


@dataclass(frozen=True)
class Served:
    """A model that can be asked, and what is known of it."""

    model: Model
    name: str  # as it is served
    manifest: Manifest
    family: Family

    @property
    def holds_to_schema(self) -> bool:
        """Whether a JSON schema can be sent along: the family's servers take one, and so does this way of asking."""
        native = self.family.structured_output == "native"
        return native and bool(self.model.profile.get("supports_json_schema_output", False))


def described(settings: Settings) -> tuple[Manifest, str | None, str]:
    """The manifest that COW_MLLM means, the provider (null for one's own server) and the name as it is served.

    Raises `ReaderUnavailable` where COW_MLLM is not set or names nothing.
    """
    asked = settings.mllm
    manifests = mllm_manifests()
    if asked is None:
        raise ReaderUnavailable(
            "Reader 'mllm' needs COW_MLLM, which is not set: a manifest's name such as qwen3-vl-8b with "
            "COW_MLLM_BASE_URL, or provider:model such as openai:gpt-5."
        )
    if asked in manifests:
        manifest = manifests[asked]
        return manifest, manifest.provider, settings.mllm_model or manifest.model or asked
    provider, colon, model = asked.partition(":")
    if not (colon and provider and model):
        close = get_close_matches(asked, manifests, n=3, cutoff=0.5)
        names = f"Did you mean {' or '.join(close)}?" if close else f"Manifests: {', '.join(manifests)}."
        raise ReaderUnavailable(f"COW_MLLM={asked!r} is no manifest and not provider:model. {names}")
    return manifest_for(model), provider, settings.mllm_model or model


def mllm_manifests() -> dict[str, Manifest]:
    """The manifests of multimodal LLMs by name."""
    return {name: manifest for name, manifest in load_manifests().items() if manifest.role == "mllm"}


def manifest_for(model: str) -> Manifest:
    """The manifest of a model by the name under which it is served; the generic one where none describes it."""
    plain = model.lower()
    manifests = mllm_manifests()
    for manifest in manifests.values():
        patterns = (manifest.model or manifest.name, *manifest.also)
        if any(fnmatchcase(plain, pattern.lower()) for pattern in patterns):
            return manifest
    return manifests[UNKNOWN]


def family_of(manifest: Manifest, served: str) -> Family:
    """The family of a model; of one that only the generic manifest fits, the one that its name speaks of, if any."""
    families = load_families()
    if manifest.name == UNKNOWN:
        plain = served.lower()
        named = (f for f in families.values() if any(fnmatchcase(plain, pattern) for pattern in f.also))
        return next(named, families[UNKNOWN])
    return families[manifest.family or UNKNOWN]


def serve(settings: Settings) -> Served:
    """The model of the settings, ready to be asked; nothing is sent. Raises `ReaderUnavailable`."""
    manifest, provider, name = described(settings)
    family = family_of(manifest, name)
    key = None if settings.mllm_api_key is None else settings.mllm_api_key.get_secret_value()
    own_protocol = settings.mllm is not None and settings.mllm.startswith(tuple(f"{p}:" for p in OWN_PROTOCOL))
    if settings.mllm_base_url is None and provider is None:
        raise ReaderUnavailable(
            f"COW_MLLM={settings.mllm!r} is served by no provider: set COW_MLLM_BASE_URL to the server that serves it "
            "(vLLM, SGLang, Ollama...), or COW_READER=local to run it in this process."
        )
    try:
        if settings.mllm_base_url is not None and not own_protocol:
            return Served(_compatible(settings.mllm_base_url, key, name, family), name, manifest, family)
        model = infer_model(f"{provider}:{name}", provider_factory=_factory(settings.mllm_base_url, key))
    except (UserError, ValueError, ImportError) as error:
        told = str(error).splitlines()[0]
        if "api" in told.lower() and "key" in told.lower():
            told = "it needs a key: set COW_MLLM_API_KEY, or the provider's own variable."
        elif "provider" in told.lower():
            told = f"there is no provider {provider!r}. Take openai, anthropic, google, mistral, groq, openrouter..."
        raise ReaderUnavailable(f"COW_MLLM={settings.mllm!r} cannot be used: {told}") from error
    return Served(model, name, manifest, family)


def _compatible(base_url: str, key: str | None, name: str, family: Family) -> Model:
    """A model behind OpenAI's protocol, whoever made it."""
    profile = OpenAIModelProfile(
        supports_json_schema_output=family.structured_output == "native",
        # The older name is the one that every such server knows.
        openai_chat_supports_max_completion_tokens=False,
    )
    provider = OpenAICompatibleProvider("mllm", base_url=base_url, api_key=key or "none")
    return OpenAIChatModel(name, provider=provider, profile=profile)


def _factory(base_url: str | None, key: str | None) -> Any:
    """Makes a provider of pydantic-ai with our key and address; what is not given comes from its own variables."""

    def make(provider: str) -> Provider[Any]:
        given = {name: value for name, value in (("base_url", base_url), ("api_key", key)) if value is not None}
        return infer_provider_class(provider)(**given)

    return make
