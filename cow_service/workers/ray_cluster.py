"""Workers on a Ray cluster: actors that do what worker processes do, each on a share of some node.

Ray ends every process that uses it once the head of the cluster has been away for a minute. So the server does not use
it: a child process does (`ray_bridge.py`). Where that ends, another one connects as soon as there is a cluster again,
and the jobs go on in other actors.
"""

import json
import logging
import math
import platform
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from itertools import count
from queue import SimpleQueue

from pydantic_core import to_json

from cow_service.concurrency import BackgroundThread, PrioritySemaphore, Spawned, spawn
from cow_service.errors import install_line
from cow_service.generators.wan.profiles import profile_of
from cow_service.jobs.queues import LIGHT, places, queue_of
from cow_service.media.artifacts import ArtifactStore
from cow_service.observability.metrics import Metrics
from cow_service.settings import WORKER_BYTES, Settings, SettingsError
from cow_service.weights.manifests import find_manifest
from cow_service.workers.messages import MAX_MESSAGE_BYTES
from cow_service.workers.pool import Group, WorkerPool
from cow_service.workers.process import Worker
from cow_service.workers.ray_bridge import MODULE, pack, unpack

SILENT_SECONDS = 5.0  # without such a report, after which the head is said to be away
RECONNECT_SECONDS, CONNECT_SECONDS = 1.0, 20.0  # between two tries to connect, and for one
AWAY_SECONDS = 90.0  # without a report, after which it is tried anew: without a head Ray ends actors after a minute
PLACE_SECONDS = 3.0  # that a job waits for a new actor where an actor that is at work could take it as well
IDLE_SECONDS = 300.0  # after which an actor that is not among the fewest gives its share of the node back

log = logging.getLogger("cow_service")


class ActorLink:
    """The way to an actor, a `Link`."""

    def __init__(self, number: int, send: Callable[[bytes], None]) -> None:
        self.pid, self.is_lost = 0, False
        self._number, self._send = number, send
        self._inbox = SimpleQueue[bytes | None]()
        self._ended, self._how = threading.Event(), ""

    def send_bytes(self, buf: bytes, /) -> None:
        """As `Link` says."""
        self._send(pack("message", self._number, buf))

    def recv_bytes(self, maxlength: int | None = None, /) -> bytes:
        """As `Link` says."""
        data = self._inbox.get()
        if data is None or len(data) > (maxlength or math.inf):
            raise EOFError
        return data

    def kill(self) -> None:
        """As `Link` says. Its end is not waited for: while the head is away, nobody tells of it."""
        with suppress(OSError):
            self._send(pack("kill", self._number))
        self.end("killed")

    def wait(self, seconds: float | None = None) -> str:
        """As `Link` says."""
        if (seconds is not None and not self.pid) or not self._ended.wait(seconds):
            raise TimeoutError  # without a place it hears nothing
        return self._how

    def close(self) -> None:
        """As `Link` says."""

    def receive(self, kind: str, data: bytes) -> None:
        """Takes what the bridge says of the actor."""
        if kind == "placed":
            self.pid = int(data)
        elif kind == "message":
            self._inbox.put(data)
        else:
            how, _, details = data.decode().partition("\n")
            if details and not self._ended.is_set():
                log.warning("a Ray actor ended: %s", details)
            self.end(how, is_lost=kind == "lost")

    def end(self, how: str, *, is_lost: bool = False) -> None:
        """Nothing more comes from the actor."""
        if not self._ended.is_set():
            self._how, self.is_lost = how, is_lost
            self._ended.set()
            self._inbox.put(None)


class Cluster(BackgroundThread):
    """The connection to a Ray cluster, made again whenever it ends. Safe to use from every thread."""

    def __init__(self, settings: Settings) -> None:
        super().__init__("cow-ray")
        self.address = settings.ray or ""
        url = settings.database_url.get_secret_value() if settings.database_url is not None else ""
        self._is_shared = url.startswith("postgres") and settings.artifacts is not None
        self.nodes: tuple[dict[str, float], ...] = ()  # the resources of each that can be used
        self.starved = set[str]()  # queues whose jobs wait for an actor that finds no place
        self._fault: str | None = f"The Ray cluster COW_RAY={self.address} is being connected to. Ask again later."
        self._heard = 0.0
        self._bridge: Spawned | None = None
        self._sending, self._links, self._numbers = threading.Lock(), dict[int, ActorLink](), count(1)

    @property
    def fault(self) -> str | None:
        """Why there are no nodes, or no actor can be started."""
        if self._fault is None and time.monotonic() - self._heard > SILENT_SECONDS:
            return f"The head of the Ray cluster COW_RAY={self.address} does not respond."
        return self._fault

    def room(self, needs: dict[str, float]) -> int:
        """How many actors with such needs the cluster has room for, if there are no others."""
        return sum(int(min(node.get(name, 0.0) / amount for name, amount in needs.items())) for node in self.nodes)

    def open_actor(self, needs: dict[str, float]) -> ActorLink:
        """The way to a new actor, which may have to wait for its place."""
        link = ActorLink(number := next(self._numbers), self._send)
        self._links[number] = link
        options = {"num_cpus": needs.get("CPU", 0), "num_gpus": needs.get("GPU", 0), "memory": int(needs["memory"])}
        try:
            self._send(pack("start", number, to_json(options)))
        except OSError:
            link.end("there is no connection to the Ray cluster", is_lost=True)
        return link

    def stop(self) -> None:
        """Ends the connection, and with it every actor."""
        self._stop.set()
        if (bridge := self._bridge) is not None:  # whoever sends to it may hold the lock for as long as it is stuck
            bridge.process.kill()
        super().stop()

    def run(self) -> None:
        """Connects, and hands each message to the actor's link that it is for."""
        while not self._stop.is_set():
            try:
                bridge = self._bridge = spawn(MODULE)
            except OSError as error:
                log.warning("the connection to the Ray cluster could not be started: %s", error)
                self._stop.wait(RECONNECT_SECONDS)
                continue
            why, patience = "the connection ended", CONNECT_SECONDS
            try:
                self._send(self.address.encode())
                while not self._stop.is_set():
                    if not bridge.pipe.poll(patience):
                        why = "it does not respond (if its head crashed, run `ray stop` and `ray start` again)"
                        break
                    kind, number, data = unpack(bridge.pipe.recv_bytes(MAX_MESSAGE_BYTES))
                    if kind == "nodes":
                        patience = AWAY_SECONDS
                        self.note_nodes(json.loads(data))
                    elif kind == "fault":
                        why = data.decode()
                    elif number in self._links:
                        self._links[number].receive(kind, data)
                        if kind in ("end", "lost"):
                            del self._links[number]
            except (EOFError, OSError):
                pass
            bridge.process.kill()  # also where it sent a message that is too long
            bridge.process.wait()
            with self._sending:
                self._bridge = None
            bridge.pipe.close()
            self.nodes = ()
            self._fault = f"The Ray cluster COW_RAY={self.address} cannot be reached: {why}."
            for number in list(self._links):
                self._links.pop(number).end("the connection to the Ray cluster ended", is_lost=True)
            if not self._stop.wait(RECONNECT_SECONDS):
                log.warning("%s", self._fault)

    def _send(self, frame: bytes) -> None:
        with self._sending:
            if self._bridge is None:
                raise OSError("not connected")
            self._bridge.pipe.send_bytes(frame)

    def note_nodes(self, nodes: list[tuple[str, dict[str, float]]]) -> None:
        """Takes the nodes that are alive: the host of each, and its resources."""
        self._heard, fault = time.monotonic(), None
        others = {host for host, _ in nodes} - {platform.node()}
        if others and not self._is_shared:
            fault = (
                f"The Ray cluster COW_RAY={self.address} has nodes on other machines, such as {min(others)}: set "
                "COW_DATABASE_URL to a PostgreSQL, and COW_ARTIFACTS to an object store or a folder that all have."
            )
        self.nodes = () if fault else tuple(resources for _, resources in nodes)
        self._fault = fault


class ActorGroup(Group):
    """The actors for one kind of jobs: from the fewest to the most that the settings allow, as jobs need them."""

    def __init__(self, name: str, settings: Settings, metrics: Metrics, cluster: Cluster) -> None:
        is_default = name in (LIGHT, queue_of(settings.reader, settings.generator, settings))
        self.fewest, self.most = settings.ray_actors.get(name, (int(is_default), None))
        if name == LIGHT and self.most:  # which share the calls of an MLLM
            settings = settings.model_copy(update={"concurrency": self.most})
        super().__init__(name, settings, metrics)
        limit, manifest = settings.worker_memory_mb, find_manifest(name)
        self.needs = {"CPU": 1.0, "memory": limit * 1e6 if limit else WORKER_BYTES}
        if settings.device != "cpu" and places(name) is not None:
            del self.needs["CPU"]  # jobs of other actors on its node do not keep it waiting
            self.needs["GPU"] = 1
            if manifest is not None and manifest.role == "generator" and settings.profile in manifest.profiles:
                self.needs["GPU"] = profile_of(manifest, settings.profile).acceleration.ranks
        elif settings.device != "cpu" and settings.perception == "gpu":
            self.needs["GPU"] = 1
        # Ray shows each actor its own GPU alone.
        own = {"device": "cuda"} if settings.device.startswith("cuda") else {}
        self._settings = self._settings.model_copy(update={"ray": None, **own})
        self.places = PrioritySemaphore(sys.maxsize)  # jobs that were taken wait in `take`
        self._cluster = cluster
        self._idle: dict[Worker, float] = {}  # since when each has had nothing to do
        self._fit()

    def alive(self) -> list[Worker]:
        """Those that have a place."""
        return [one for one in super().alive() if one.link.pid]

    def _choose(self, *, fresh: bool) -> Worker | None:
        """With `fresh` an actor without jobs. Starts another one where all have some."""
        limit = 1 if fresh else self.jobs_each
        free = [one for one in self.workers if one.link.pid and one.is_alive and self._taken[one] < limit]
        best = min(free, key=lambda one: (self._taken[one], not one.is_loaded), default=None)
        coming = [one for one in self.workers if not one.link.pid]
        if (best is None or self._taken[best]) and len(coming) < self._waiting:
            self._start_another(self.size)
        asked = max((one.heard for one in coming), default=-math.inf)
        is_taken = best is not None and (not self._taken[best] or time.monotonic() - asked > PLACE_SECONDS)
        return best if is_taken else None

    def fill(self, *, first: bool = False) -> None:
        """Fits their number to the cluster and the jobs, from the first on."""
        with self._lock:
            self._clean_up()
            self._fit()
            if self._cluster.fault is not None:
                self.fault, self._failed_starts, self._next_start = None, 0, 0.0  # it is no fault of the backends
                return
            self._start_another(min(self.fewest or int(self.fault is not None), self.size))
            now, crowded = time.monotonic(), bool(self._cluster.starved - {self.name})
            has_late = any(not one.link.pid and now - one.heard > PLACE_SECONDS for one in self.workers)
            (self._cluster.starved.add if self._waiting and has_late else self._cluster.starved.discard)(self.name)
            free = [one for one in self.workers if one.is_loaded or not (one.link.pid or self._waiting)]
            self._idle = {one: self._idle.get(one, now) for one in free if not self._taken[one]}
            for one, since in self._idle.items():
                limit = IDLE_SECONDS if one.is_loaded else PLACE_SECONDS
                if (crowded and one.is_loaded) or (len(self.workers) > self.fewest and now - since > limit):
                    self.workers.remove(one)
                    del self._taken[one]
                    threading.Thread(target=one.close, args=("renewed",), name="cow-actor-end", daemon=True).start()

    def _fit(self) -> None:
        room = self._cluster.room(self.needs)
        self.size = room if self.most is None or not self._cluster.nodes else self.most  # there may be more nodes soon

    def _start_another(self, most: int) -> None:
        if len(self.workers) < most and time.monotonic() >= self._next_start and self._cluster.fault is None:
            self._start()

    def _make(self, name: str) -> Worker:
        return Worker(name, self._settings, self._note_end, self._cluster.open_actor(self.needs))


class RayCluster(WorkerPool):
    """All actors of this process."""

    def __init__(self, settings: Settings, metrics: Metrics, artifacts: ArtifactStore) -> None:
        """Raises `SettingsError` where Ray is not installed."""
        if find_spec("ray") is None:
            raise SettingsError(f"Bad settings: COW_RAY is set, but Ray is not installed: {install_line('ray')}")
        super().__init__(settings, metrics, artifacts)
        # Nodes have their own memory, and Ray ends what takes too much of it.
        self._memory, self._memory_of_all = PrioritySemaphore(sys.maxsize), math.inf
        if settings.worker_memory_mb is None:
            self._memory_limit = math.inf
        self.cluster = Cluster(settings)

    def start(self) -> None:
        """Connects, and starts the first actors as soon as they have a place."""
        if self._watching is None:
            self.cluster.start()
        super().start()

    def close(self) -> None:
        """Ends all actors and the connection."""
        super().close()
        self.cluster.stop()

    def fault(self) -> str | None:
        """Why jobs wait."""
        for group in self._default_groups():
            if self.cluster.fault is None and isinstance(group, ActorGroup) and group.size == 0:
                needs = [f"{amount:g} {name}" for name, amount in group.needs.items() if name != "memory"]
                told = ", ".join([*needs, f"{group.needs['memory'] / 1e6:.0f} MB of memory"])
                return f"No node of the Ray cluster has what an actor of the queue {group.name!r} needs: {told}."
        return self.cluster.fault or super().fault()

    def _new_group(self, name: str) -> Group:
        return ActorGroup(name, self._settings, self._metrics, self.cluster)

    def _judge(self, worker: Worker, now: float) -> None:
        if not worker.link.pid and worker.is_alive:
            worker.started = now  # it waits for a place, however long
        super()._judge(worker, now)
