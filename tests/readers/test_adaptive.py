"""The adaptive limit: on a simulated clock, against servers with a limit of calls; then on sockets."""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from drawn import floor
from hypothesis import given
from hypothesis import strategies as st
from mllm_server import completion, mllm_server

from cow_service.adaptive import FIRST, MAX_PAUSE_SECONDS, AdaptiveLimit
from cow_service.perception.observation import look
from cow_service.readers.base import ReaderInput
from cow_service.settings import Settings

pytestmark = pytest.mark.slow


@dataclass
class Simulation:
    """Calls of a server that accepts `accepted(now)` at once, `seconds(now, in flight)` each, and refuses others."""

    most: int
    accepted: Callable[[float], float] = lambda _: math.inf
    seconds: Callable[[float, int], float] = lambda _, __: 2.0
    refusal_seconds: float = 0.005
    now: float = 0.0
    refused: int = 0
    at_server: int = 0
    limits: list[tuple[float, int]] = field(default_factory=list)
    limit: AdaptiveLimit = field(init=False)

    def __post_init__(self) -> None:
        self.limit = AdaptiveLimit(self.most, lambda: self.now)

    def run(self, calls: int) -> float:
        """How long a number of calls take, if refused ones are repeated at once."""
        events: list[tuple[float, int, str, float]] = []
        todo, done, number = calls, 0, 0
        while done < calls:
            while todo and (wait := self.limit.seconds_to_wait()) == 0:
                began, todo = self.limit.begin(), todo - 1
                kind, seconds = "refused", self.refusal_seconds
                if self.at_server < self.accepted(self.now):
                    self.at_server += 1
                    kind, seconds = "done", self.seconds(self.now, self.at_server)
                heapq.heappush(events, (self.now + seconds, number := number + 1, kind, began))
            if todo and wait < math.inf:
                heapq.heappush(events, (self.now + wait, number := number + 1, "look", 0.0))
            assert self.limit.in_flight <= self.most
            self.now, _, kind, began = heapq.heappop(events)
            if kind == "refused":
                self.refused, todo = self.refused + 1, todo + 1
                self.limit.refuse(began)
            done += kind == "done"
            self.at_server -= kind == "done"
            if kind != "look":
                self.limit.end(began, succeeded=kind == "done")
            assert 1 <= self.limit.limit <= self.most
            self.limits.append((self.now, self.limit.limit))
        return self.now


@given(
    accepted=st.integers(16, 200), most=st.integers(1, 300), jitter=st.sampled_from([0.0, 0.3]), seed=st.integers(0, 9)
)
def test_it_finds_what_is_accepted_with_few_refusals(accepted: int, most: int, jitter: float, seed: int) -> None:
    draws = random.Random(seed)
    calls = 20 * min(accepted, most)
    server = Simulation(most, lambda _: accepted, lambda *_: 2 * draws.uniform(1 - jitter, 1 + jitter))
    ideal = calls * 2 / min(accepted, most)
    assert server.run(calls) < 1.5 * ideal
    assert server.refused <= 0.02 * calls + 1
    assert (server.refused == 0) == (most <= accepted)


def test_sixty_four_places_are_reached_in_a_few_round_trips_and_used() -> None:
    server = Simulation(256, lambda _: 64)
    assert server.run(1320) < 1.3 * 1320 * 2 / 64
    assert server.refused <= 0.02 * 1320
    assert next(now for now, limit in server.limits if limit >= 64) <= 5 * 2.0


@pytest.mark.parametrize("accepted", [1, 3])
def test_a_server_that_accepts_few_is_rarely_asked_for_more(accepted: int) -> None:
    server = Simulation(64, lambda _: accepted)
    server.run(500)
    assert server.refused <= 2 * FIRST + 0.02 * 500  # the first calls, and those that find out
    assert server.limits[-1][1] <= accepted + 1


def test_it_recovers_when_more_is_accepted_and_after_an_outage() -> None:
    draws = random.Random(0)
    server = Simulation(256, lambda now: 20 if now < 60 else 100, lambda *_: draws.uniform(1.6, 2.4))
    server.run(4000)
    assert server.limits[-1][1] > 80
    server = Simulation(64, lambda now: 0 if 30 < now < 32 else 64, refusal_seconds=0.2)
    server.run(2500)
    assert min(limit for _, limit in server.limits) < 16
    assert server.limits[-1][1] == 64


def test_calls_in_flight_together_halve_it_once() -> None:
    now = 0.0
    limit = AdaptiveLimit(64, lambda: now)
    flying = [limit.begin() for _ in range(FIRST)]
    assert limit.seconds_to_wait() == math.inf
    now = 1.0
    for began in flying:
        limit.refuse(began)
    assert limit.limit == FIRST // 2
    for began in flying:
        limit.end(began, succeeded=False)
    again = limit.begin() + 1e-9  # after the halving
    now = 2.0
    limit.refuse(again)
    assert limit.limit == 1


def test_it_grows_only_while_calls_wait() -> None:
    now = 0.0
    limit = AdaptiveLimit(64, lambda: now)
    for _ in range(200):
        assert limit.seconds_to_wait() == 0
        began = limit.begin()
        now += 1.0
        limit.end(began, succeeded=True)
    assert limit.limit == FIRST


@pytest.mark.parametrize(("asked", "kept"), [(7.0, 7.0), (1000.0, MAX_PAUSE_SECONDS)])
def test_a_retry_after_holds_all_calls_back(asked: float, kept: float) -> None:
    now = 0.0
    limit = AdaptiveLimit(64, lambda: now)
    began = limit.begin()
    limit.refuse(began, asked)
    limit.end(began, succeeded=False)
    assert limit.seconds_to_wait() == limit.seconds_paused == kept == min(asked, 60)
    now = kept
    assert limit.seconds_to_wait() == limit.seconds_paused == 0


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_calls_of_very_different_lengths_are_made_as_many(share: float) -> None:
    draws = random.Random(1)
    server = Simulation(64, seconds=lambda *_: 0.005 if draws.random() < share else draws.uniform(1, 3))
    assert server.run(3000) < 1.2 * 3000 * 2 * (1 - share) / 64


def test_calls_that_become_longer_for_good_are_made_as_many() -> None:
    draws = random.Random(1)
    server = Simulation(64, seconds=lambda now, _: (1 if now < 40 else 5) * draws.uniform(0.8, 1.2))
    server.run(4000)
    assert server.limits[-1][1] == 64


def test_an_mllm_is_called_more_often_at_once_as_it_accepts_more(tmp_path) -> None:
    """Over sockets: calls that are refused are made again, and all places are free at the end."""
    from cow_service.readers.mllm.client import MllmClient, PromptCall
    from cow_service.readers.mllm.models import configure

    accepted, calls, begun, most, refused = 12, 80, 0, 0, 0
    with mllm_server() as mllm:
        settings = Settings(mllm="generic", mllm_base_url=mllm.address, data_dir=tmp_path)
        client = MllmClient(configure(settings), settings)
        limit = client.places.limit

        def reply(handler: Any) -> None:
            nonlocal begun, most, refused
            with mllm.lock:
                most = max(most, limit.limit)
                is_accepted = begun < accepted
                begun, refused = begun + is_accepted, refused + (not is_accepted)
            if not is_accepted:
                handler.send(429, {"error": {"message": "busy"}}, {"retry-after": "0"})
                return
            with mllm.lock:
                begun -= 1
            handler.send(200, completion("42"))

        mllm.say(reply)
        asked = {"question": "How many?", "shown": "nothing", "facts": ()}
        prompts = [PromptCall("eval-question", asked, (), {"type": "object"}, int, vote) for vote in range(calls)]
        replies = client.complete_all(prompts, ReaderInput(floor(8, 8), "How many?", look(floor(8, 8))))
        client.close()
    assert replies == [42] * calls
    assert most > FIRST
    assert len(mllm.asked) == calls + refused
    assert limit.in_flight == client.places.waiting == 0
