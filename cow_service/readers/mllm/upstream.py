"""Where chats with the multimodal LLM of the settings can be sent on as they are."""

from __future__ import annotations

from typing import Any

from openai import AsyncAzureOpenAI, AsyncOpenAI

from cow_service.readers.chat import Upstream
from cow_service.readers.mllm.models import OWN_PROTOCOL, ConfiguredModel, ResolvedModel
from cow_service.settings import Settings

NO_KEY = "none"  # what stands for a key where a client library wants one


def upstream_of(settings: Settings, resolved: ResolvedModel, configured: ConfiguredModel) -> Upstream | None:
    """The OpenAI-compatible server of the settings, or that of a provider; None for a protocol of its own."""
    if settings.mllm_base_url is not None and resolved.provider not in OWN_PROTOCOL:
        key = None if settings.mllm_api_key is None else settings.mllm_api_key.get_secret_value()
        return Upstream(settings.mllm_base_url.rstrip("/"), resolved.name, key)
    client: Any = getattr(configured.model, "client", None)
    # Azure's addresses and headers are its own.
    if not isinstance(client, AsyncOpenAI) or isinstance(client, AsyncAzureOpenAI):
        return None
    key = client.api_key if client.api_key != NO_KEY else None
    return Upstream(str(client.base_url).rstrip("/"), resolved.name, key or None)
