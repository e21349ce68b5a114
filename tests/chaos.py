"""A laboratory of faults: callers of three tenants, what strikes their servers, and whether they were told the truth.

A schedule of faults follows from a seed. Meanwhile everything that callers are told is noted. When all has been set
right again and every job has ended, `check` compares that history with what is there.
"""

from __future__ import annotations

import hashlib
import json
import random
import socket
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
from faults import (
    Fault,
    Machine,
    Station,
    a_cleaner,
    a_second_server,
    faults_of,
    faults_of_database,
    faults_of_network,
    power_cut,
)
from postgres import postgres
from proxy import Proxy
from servers import BODY, TERMINAL, Served, Worker, data_url, picture
from waiting import TIME_LIMIT, eventually

from cow_service.api.middleware.access import hash_of, new_key

TENANTS = ("alice", "bob", "carol")
PAUSE = (0.05, 0.3)  # seconds between two calls of a tenant
OWN, OTHERS = (200, 202, 503), (404, 503)  # what callers may be told of their own jobs, and of those of others


@dataclass(frozen=True)
class Told:
    """One answer to a tenant: about a request of its own, a job in its list, or another tenant's job."""

    tenant: str
    status: int
    seed: int | None = None  # of its own request
    job_id: str | None = None
    result: str | None = None  # the SHA-256 of the job's result
    begun: int = 0  # with a result: how often its clip had been begun
    frame: str | None = None  # with a result: an artifact
    is_foreign: bool = False
    text: str = ""  # of an error


@dataclass(frozen=True)
class Kept:
    """A job as its tenant finds it in the end."""

    tenant: str
    job_id: str
    status: str
    seed: int  # of the request
    result: str | None = None
    result_seed: int | None = None
    artifacts: Mapping[str, str] = field(default_factory=dict[str, str])  # by digest, that of the bytes that came


def seed_of(tenant: str, number: int) -> int:
    """Tells one request from all others. All tenants use the number as the idempotency key."""
    return len(TENANTS) * number + TENANTS.index(tenant)


def check(history: Iterable[Told], kept: Sequence[Kept], begun: Mapping[int, int] | None = None) -> list[str]:
    """What is wrong: each acknowledged job must be there, once, whole, its owner's alone, and have ended well.

    `begun`: how often the clip of each seed was begun, where no clip may be made again that its tenant knows.
    """
    wrong: list[str] = []
    jobs = {(job.tenant, job.job_id): job for job in kept}
    ids = defaultdict[int, set[str]](set)
    for told in history:
        if told.status not in (OTHERS if told.is_foreign else OWN):
            wrong.append(f"unexpected answer: {told}")
        if told.job_id is None:
            continue
        if told.seed is not None:
            ids[told.seed].add(told.job_id)
        job = jobs.get((told.tenant, told.job_id))
        if job is None:
            wrong.append(f"lost, or not {told.tenant}'s: {told}")
        elif told.seed is not None:
            if job.seed != told.seed:
                wrong.append(f"not the job of the request: {told}, {job}")
            if told.result not in (None, job.result):
                wrong.append(f"another result than was told: {told}, {job}")
            if told.result and begun is not None and begun.get(told.seed, 0) > told.begun:
                wrong.append(f"its clip was made again: {told}")
    for job in kept:
        ids[job.seed].add(job.job_id)
        if job.seed % len(TENANTS) != TENANTS.index(job.tenant):
            wrong.append(f"the request of another tenant: {job}")
        if job.status != "succeeded":
            wrong.append(f"did not end well: {job}")
        elif job.result_seed != job.seed:
            wrong.append(f"the result of another request: {job}")
        wrong += [f"damaged artifact {name}: {job}" for name, digest in job.artifacts.items() if name != digest]
    return wrong + [
        f"several jobs of the request {seed}: {several}" for seed, several in ids.items() if len(several) > 1
    ]


@dataclass(frozen=True)
class Wave:
    """Faults at the same time, and seconds before and during them."""

    faults: tuple[Fault, ...]
    pause: float
    seconds: float

    def __str__(self) -> str:
        return f"{' + '.join(fault.name for fault in self.faults)} for {self.seconds:.1f} s"


def schedule(
    chance: random.Random, always: Fault, others: Sequence[Fault], waves: tuple[int, int], longest: float
) -> list[Wave]:
    """Waves with the fault `always`, and waves with one of the others, each equally often; some with two."""
    deck: list[Fault] = []
    while len(deck) < waves[1]:
        deck += chance.sample(others, len(others))
    drawn = [always] * waves[0] + deck[: waves[1]]
    chance.shuffle(drawn)
    made: list[Wave] = []
    for fault in drawn:
        second = chance.choice(others)
        pause, seconds = chance.uniform(0, max(1, longest / 5)), longest * chance.random() ** 3
        is_alone = chance.random() < 0.5 or (fault.halts and second.halts and fault.station is second.station)
        made.append(Wave((fault,) if is_alone or fault is second else (fault, second), pause, seconds))
    halting = {id(fault.station): fault for fault in chance.sample(others, len(others)) if fault.halts}
    others_at_once = [fault for fault in others if not fault.halts]
    at_once = (always, *halting.values(), *others_at_once) if always.station is None else (always, *others_at_once)
    return [*made, Wave(at_once, 0.0, longest / 2)]


class Laboratory:
    """Stations, callers, and the history of what they were told."""

    def __init__(self, stations: Sequence[Station], keys: Mapping[str, str], journal: Path | None = None) -> None:
        """`journal`: where no clip may be made again that its tenant knows."""
        self.stations, self.servers = stations, [one for one in stations if one.url is not None]
        self._keys, self._journal = keys, journal
        self.history: list[Told] = []
        self.acknowledged: set[str] = set()  # jobs
        self.unanswered: list[str] = []
        self.is_over = threading.Event()
        self._callers: list[Caller] = []
        self.begun_at = time.monotonic()

    def note(self, told: Told) -> None:
        self.history.append(told)
        if told.seed is not None and told.job_id is not None:
            self.acknowledged.add(told.job_id)

    def run(self, waves: Iterable[Wave], chance: random.Random) -> None:
        """Lets the waves strike while callers call, each as soon as a new job was acknowledged."""
        self._callers = [Caller(self, tenant, random.Random(chance.random())) for tenant in TENANTS]
        for caller in self._callers:
            caller.start()
        for station in self.stations:
            station.program.launch()
        try:
            self._wait_for_job("at first")
            for wave in waves:
                time.sleep(wave.pause)
                self._wait_for_job(f"before {wave}")
                for fault in wave.faults:
                    self._strike(fault)
                time.sleep(wave.seconds)
                for fault in wave.faults:
                    self._heal(fault)
                self._wait_for_job(f"after {wave}")
                print(f"{time.monotonic() - self.begun_at:6.1f} s: {wave}, {len(self.acknowledged)} jobs", flush=True)
        finally:
            self.is_over.set()
            for caller in self._callers:
                caller.join()

    def _strike(self, fault: Fault) -> None:
        if fault.station is not None and fault.halts:
            fault.station.halts, fault.station.is_halted = fault.station.halts + 1, True
        fault.strike()

    def _heal(self, fault: Fault) -> None:
        fault.heal()
        if fault.station is not None and fault.halts:
            fault.station.is_halted = False

    def supervise(self) -> None:
        """Starts again what has ended, as a service manager does: a server may not have come up on a full disk."""
        for station in self.stations:
            process = station.program.process
            if not station.is_halted and process is not None and process.poll() is not None:
                station.program.launch()

    def _wait_for_job(self, when: str) -> None:
        had = len(self.acknowledged)

        def look() -> bool:
            assert all(caller.is_alive() for caller in self._callers), (
                "a caller ended: its exception is a warning below"
            )
            self.supervise()
            return len(self.acknowledged) > had

        try:
            eventually(look)
        except AssertionError as error:
            raise AssertionError(f"no job was acknowledged {when}") from error

    def begun(self) -> Counter[int]:
        """How often the clip of each seed was begun."""
        return Counter(int(line) for line in self._journal.read_text().split()) if self._journal else Counter()

    def findings(self) -> list[str]:
        """Once all is set right again: what is wrong."""
        kept = [job for tenant in TENANTS for job in self._kept_of(tenant)]
        told = Counter((one.status, "foreign" if one.is_foreign else "own") for one in self.history)
        print(f"{len(kept)} jobs; told: {dict(told)}; {time.monotonic() - self.begun_at:.1f} s")
        return check(self.history, kept, self.begun() if self._journal else None) + self.unanswered

    def client(self, tenant: str) -> httpx.Client:
        return httpx.Client(headers={"Authorization": f"Bearer {self._keys[tenant]}"}, timeout=TIME_LIMIT)

    def _kept_of(self, tenant: str) -> list[Kept]:
        with self.client(tenant) as http:

            def ask(path: str, **query: Any) -> httpx.Response:
                def answer() -> httpx.Response | None:
                    self.supervise()
                    try:
                        response = http.get(f"{self.servers[0].url}{path}", params=query)
                    except httpx.TransportError:
                        return None
                    return None if response.status_code == 503 else response

                return eventually(answer)

            def listed() -> list[str]:
                jobs: list[dict[str, Any]] = []
                cursor: dict[str, str] = {}
                while True:
                    page = ask("/jobs", limit=500, **cursor).json()
                    jobs += page["jobs"]
                    if not page["next"]:
                        break
                    cursor = {"cursor": page["next"]}
                return [job["id"] for job in jobs] if all(job["status"] in TERMINAL for job in jobs) else []

            return [self._kept_job(tenant, ask(f"/jobs/{job_id}").json(), ask) for job_id in eventually(listed)]

    def _kept_job(self, tenant: str, job: dict[str, Any], ask: Callable[..., httpx.Response]) -> Kept:
        seed = ask(f"/jobs/{job['id']}/request").json()["request"]["seed"]
        result = job["result"]
        if result is None:
            print(job["id"], job["status"], job["problem"])
            return Kept(tenant, job["id"], job["status"], seed)
        artifacts = {one: sha256(ask(f"/artifacts/{one}").content) for one in artifacts_of(result)}
        return Kept(tenant, job["id"], job["status"], seed, digest_of(result), result["generator"]["seed"], artifacts)


def artifacts_of(result: dict[str, Any]) -> set[str]:
    shown = [*result["frames"], result["overlay"], result["grounding"]["mask"], result["image"]]
    return {one["sha256"] for one in shown if one}


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def digest_of(result: dict[str, Any]) -> str:
    return sha256(json.dumps(result, sort_keys=True).encode())


class Caller(threading.Thread):
    """A tenant: it sends requests, also again, looks at its jobs, and tries what belongs to others."""

    def __init__(self, laboratory: Laboratory, tenant: str, chance: random.Random) -> None:
        super().__init__(name=tenant)
        self._laboratory, self._tenant, self._chance = laboratory, tenant, chance
        self._image = data_url(picture(TENANTS.index(tenant)))
        self._sent = 0

    def run(self) -> None:
        acts = [self._send_new, self._send_new, self._send_again, self._look, self._list, self._pry]
        with self._laboratory.client(self._tenant) as self._http:
            while not self._laboratory.is_over.wait(self._chance.uniform(*PAUSE)):
                self._chance.choice(acts)()

    def _send_new(self) -> None:
        self._sent += 1
        self._send(self._sent)

    def _send_again(self) -> None:
        self._send(self._chance.randint(0, self._sent))

    def _send(self, number: int) -> None:
        seed = seed_of(self._tenant, number)
        slow = {"generator": "slow", "generator_options": {"seconds": 0.5}} if number % 2 else {}
        body = {**BODY, "image": self._image, "seed": seed, **slow}
        # All tenants use the same keys.
        headers = {"Idempotency-Key": f"job-{number}", "Prefer": self._chance.choice(["respond-async", "wait=2"])}
        self._note_job(self._call("POST", "/simulate", json=body, headers=headers), seed)

    def _look(self) -> None:
        if told := self._choose(lambda told: told.tenant == self._tenant):
            self._note_job(self._call("GET", f"/jobs/{told.job_id}"), told.seed)

    def _list(self) -> None:
        response = self._call("GET", "/jobs", params={"limit": 20})
        if response is not None:
            jobs = response.json()["jobs"] if response.is_success else [{"id": None}]
            for job in jobs:
                self._laboratory.note(Told(self._tenant, response.status_code, job_id=job["id"]))

    def _pry(self) -> None:
        if told := self._choose(lambda told: told.tenant != self._tenant):
            job = f"/jobs/{told.job_id}"
            ways = [("GET", job), ("DELETE", job), ("POST", f"{job}/cancel"), ("GET", f"{job}/request")]
            ways += [("GET", f"/artifacts/{told.frame}")] if told.frame else []
            response = self._call(*self._chance.choice(ways))
            if response is not None:
                self._laboratory.note(Told(self._tenant, response.status_code, is_foreign=True, text=response.text))

    def _choose(self, which: Callable[[Told], bool]) -> Told | None:
        """An earlier answer about a request."""
        found = [told for told in self._laboratory.history if told.seed is not None and told.job_id and which(told)]
        return self._chance.choice(found) if found else None

    def _note_job(self, response: httpx.Response | None, seed: int | None) -> None:
        """What was said of a job: a submission that waited is answered with the result, all else with the job."""
        if response is None:
            return
        told = Told(self._tenant, response.status_code, seed, text=response.text[:500])
        if response.is_success:
            content = response.json()
            result = content.get("result") if "status" in content else content
            told = replace(told, job_id=content["id"], text="")
            if result is not None:
                begun = self._laboratory.begun()[seed]
                told = replace(told, result=digest_of(result), frame=result["frames"][0]["sha256"], begun=begun)
        self._laboratory.note(told)

    def _call(self, method: str, path: str, **options: Any) -> httpx.Response | None:
        """The answer of one of the servers; None if there was none, which only one that is struck may do."""
        server = self._chance.choice(self._laboratory.servers)
        halts, was_halted = server.halts, server.is_halted
        try:
            return self._http.request(method, f"{server.url}{path}", **options)
        except httpx.TransportError as error:
            is_late = isinstance(error, httpx.TimeoutException)
            if is_late and not was_halted and not server.is_halted and server.halts == halts:
                self._laboratory.unanswered.append(f"no answer of {server.url} in {TIME_LIMIT:g} s: {method} {path}")
            return None


def tenants() -> tuple[dict[str, str], dict[str, str]]:
    """Settings that know the tenants, and their keys."""
    keys = {name: new_key() for name in TENANTS}
    hashes = {name: hash_of(key) for name, key in keys.items()}
    return {"COW_API_KEYS": json.dumps(hashes), "COW_SHUTDOWN_GRACE": "2"}, keys


def server_in(folder: Path, **settings: str) -> Station:
    """A server that is always at the same port."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    machine = Machine(folder)
    program = Served(folder, COW_PORT=str(port), COW_WORKERS="true", **machine.environment, **settings)
    return Station(program, machine, f"http://127.0.0.1:{port}")


@contextmanager
def one_machine(folder: Path) -> Generator[tuple[Laboratory, Fault, list[Fault]]]:
    """A server with its workers, SQLite and a folder of artifacts; a loss of power, and its other faults."""
    settings, keys = tenants()
    with ExitStack() as ending:
        station = server_in(folder / "server", **settings)
        ending.callback(station.program.end)
        laboratory = Laboratory([station], keys, station.program.journal)
        others = [*faults_of("the server", station), a_second_server(station), a_cleaner(station)]
        yield laboratory, power_cut(station), others


@contextmanager
def fleet(folder: Path) -> Generator[tuple[Laboratory, Fault, list[Fault]]]:
    """Two servers, one of them without computing, and a worker; PostgreSQL and an object store. A crash of PostgreSQL,
    and all other faults, those of networks among them.
    """
    from object_store import serving

    settings, keys = tenants()
    with ExitStack() as ending:
        database, store = ending.enter_context(postgres()), ending.enter_context(serving())
        to_store = ending.enter_context(Proxy(urlsplit(store.endpoint).port or 80))
        settings |= store.environment
        settings |= {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{to_store.port}",
            "COW_ARTIFACTS": store.url,
            "COW_ARTIFACTS_REDIRECT": "false",
            "COW_CONCURRENCY": "1",
        }
        faults = [
            Fault("object store away", store.stop, store.start),
            *faults_of_network("the object store", to_store),
            *faults_of_database(database),
        ]
        stations: list[Station] = []
        for name, role in (("api", "api"), ("server", "all"), ("worker", None)):
            to_database = ending.enter_context(Proxy(database.port))
            own = settings | {"COW_DATABASE_URL": database.url.replace(str(database.port), str(to_database.port))}
            if role is None:
                machine = Machine(folder / name)
                worker = Worker(folder / name, "log", **machine.environment, **own)
                station = Station(worker, machine)
            else:
                station = server_in(folder / name, COW_ROLE=role, **own)
            ending.callback(station.program.end)
            stations.append(station)
            faults += faults_of(name, station) + faults_of_network(f"the database at {name}", to_database)
        yield Laboratory(stations, keys), Fault("crash of PostgreSQL", database.kill, database.start), faults
