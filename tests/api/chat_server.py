"""One server with an MLLM on loopback for all tests that chat: a plugin of pytest that their files name."""

from __future__ import annotations

import json
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING

import pytest
from chats import KEY
from conftest import DATA
from random_mllm import RandomMllm, random_mllm
from servers import Served

if TYPE_CHECKING:
    from openai import OpenAI


FIELDS = {name for row in json.loads((DATA / "chat_fields.json").read_text()) for name in row["fields"]}


@pytest.fixture(scope="session")
def session_mllm() -> Iterator[RandomMllm]:
    with random_mllm() as one:
        yield one


@pytest.fixture
def mllm(session_mllm: RandomMllm) -> RandomMllm:
    """The MLLM behind `served`. It has forgotten what other tests sent it, and what it was to say."""
    session_mllm.received.clear()
    session_mllm.next_replies.clear()
    return session_mllm


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory, session_mllm: RandomMllm) -> Iterator[Served]:
    own = {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": session_mllm.address, "COW_MLLM_API_KEY": KEY}
    own |= {"COW_MAX_BODY_MB": "3", "COW_CHAT_FIELDS": ", ".join([*FIELDS, "x", "unknown"])}
    with Served(tmp_path_factory.mktemp("chats"), **own) as one:
        yield one
        assert "Traceback" not in one.log()
        assert KEY not in one.log()


@pytest.fixture(scope="session")
def openai() -> ModuleType:
    """OpenAI's library, which takes long to import."""
    import openai

    return openai


@pytest.fixture(scope="session")
def client(served: Served, openai: ModuleType) -> Iterator[OpenAI]:
    with openai.OpenAI(base_url=f"{served.http.base_url}/v1", api_key="any", max_retries=0) as one:
        yield one
