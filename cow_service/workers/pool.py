"""The worker processes of one server or worker: how many there are, which job each gets, and when one is replaced.

Jobs of light generators share some processes, `COW_CONCURRENCY` of them. A generator with a device of its own has a
process of its own: no photograph's frames wait for its clips, and its weights are loaded once.
"""

import logging
import math
import threading
import time
from collections.abc import Callable
from functools import partial
from itertools import count

from cow_service.adaptive import FIRST
from cow_service.concurrency import PrioritySemaphore
from cow_service.errors import Canceled, CowError, DeviceFailed, WorkerEnded
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.computing import Computer, JobOutcome, KeyLocks, Work, waiting_jobs
from cow_service.jobs.queues import LIGHT, clips, places, queue_of
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import pixels_in
from cow_service.observability.metrics import Metrics
from cow_service.records import WorkerInfo
from cow_service.settings import WORKER_BYTES, Settings
from cow_service.stages.run import priority_of
from cow_service.weights.manifests import find_manifest
from cow_service.workers.process import EndReason, Worker, WorkerGone

MAX_CRASHES = 3  # of workers that had nothing but the job, or of their device
HEARTBEAT_TIMEOUT_SECONDS = 15.0  # after which a worker that says nothing is ended
WATCH_SECONDS = 1.0  # between two looks at each worker
FIRST_PAUSE_SECONDS, LONGEST_PAUSE_SECONDS = 1.0, 60.0  # after a worker that could not start; doubled each time
LOAD_POLL_SECONDS = 0.02  # between two looks whether a worker has loaded: the start of a server waits for it
POLL_SECONDS = 0.1  # how often a job that waits for such a pause checks whether it was canceled
RENEW_SHARE = 0.75  # of the memory that a worker may take, from which on one without a job is replaced
# Of a job, beside what a worker takes for small images. `benchmarks/memory.py` measures the kinds of pictures: with a
# depth map a job takes most, at 24 megapixels 450 MB.
BYTES_PER_PIXEL, BYTES_PER_PIXEL_OF_A_MASK = 12, 2
CLIP_SIDE = 1280  # px: frames are no larger

log = logging.getLogger("cow_service")


class Group:
    """The workers for one kind of jobs: the first is started when it is needed, the others when that has loaded."""

    def __init__(self, name: str, settings: Settings, metrics: Metrics) -> None:
        """`settings` are the server's; each worker gets its share of them."""
        waiting, calls = waiting_jobs(settings), settings.mllm_concurrency
        size, cpu, computing, generator = 1, 1, 1, settings.generator
        if name == LIGHT:
            size = settings.concurrency
            waiting, calls = math.ceil(waiting / size), math.ceil(calls / size)
            if clips(generator, settings) is not None:
                generator = "cutout"
        elif name == settings.reader and places(name) is not None:  # a reader that computes on a device
            cpu = computing = settings.concurrency
            waiting = min(settings.mllm_concurrency, FIRST)  # it replies to a few at a time
        else:
            generator, computing = name, clips(name, settings) or 1
        share = {"concurrency": cpu, "mllm_concurrency": calls, "generator": generator}
        self.name, self.size, self.jobs_each = name, size, computing + waiting
        self.places = PrioritySemaphore(self.size * self.jobs_each)
        self.workers: list[Worker] = []
        self.was_loaded = False  # whether a worker has loaded the default backends
        self.fault: str | None = None  # why the last worker that was started could not load them
        self.alone = threading.Lock()  # held by a job that is computed for itself, as its last worker crashed
        self._settings, self._metrics = settings.model_copy(update=share), metrics
        self._lock = threading.Lock()
        self._taken: dict[Worker, int] = {}
        self._waiting = 0  # jobs in `take`
        self._closed = False
        self._failed_starts, self._next_start = 0, 0.0  # in a row; the time before which none is started
        self._latest: Worker | None = None  # that was started

    def fill(self, *, first: bool = False) -> None:
        """Starts the next worker of all that there may be, once those that were started have loaded.

        The first one where that is wanted, and after a pause where it could not start.
        """
        with self._lock:
            self._clean_up()
            is_wanted = len(self.workers) < self.size if self.workers else first or self.fault is not None
            is_ready = all(one.is_loaded and one.is_alive for one in self.workers)
            if is_wanted and is_ready and not self._closed and time.monotonic() >= self._next_start:
                self._start()

    def take(self, check: Callable[[], None], *, fresh: bool = False) -> Worker:
        """The worker with the fewest jobs, or a new one where all have some and there may be more.

        Where workers cannot start, it waits for the next try; what `check` raises ends the wait.
        """
        with self._lock:
            self._waiting += 1
        try:
            while True:
                with self._lock:
                    self._clean_up()
                    if (chosen := self._choose(fresh=fresh)) is not None:
                        self._taken[chosen] += 1
                        return chosen
                check()
                time.sleep(POLL_SECONDS)
        finally:
            with self._lock:
                self._waiting -= 1

    def give_back(self, worker: Worker, *, renew: bool) -> None:
        """The job of a worker has ended. A worker due for renewal gets no more jobs, and ends once it has none."""
        with self._lock:
            self._taken[worker] -= 1
            if (renew or not worker.is_alive) and worker in self.workers:
                self.workers.remove(worker)
            ends = worker not in self.workers and not self._taken[worker]
            if ends:
                del self._taken[worker]
        if ends:
            threading.Thread(target=worker.close, args=("renewed",), name="cow-worker-end", daemon=True).start()

    def alive(self) -> list[Worker]:
        """Its workers that are alive."""
        with self._lock:
            return [one for one in self._taken if one.is_alive]

    def close(self) -> None:
        """Ends all workers."""
        with self._lock:
            self._closed = True
            workers, self.workers = self.workers, []
        for worker in workers:
            worker.close()

    def _choose(self, *, fresh: bool) -> Worker | None:
        free = [one for one in self.workers if one.is_alive and self._taken[one] < self.jobs_each]
        best = min(free, key=lambda one: self._taken[one], default=None)
        wants_new = fresh or best is None or (self._taken[best] and len(self.workers) < self.size)
        if wants_new and time.monotonic() >= self._next_start:
            return self._start()
        return None if fresh else best  # the job may end the process that it is given to

    def _start(self) -> Worker | None:
        """A new worker; None where the system gives no process or thread for it."""
        if self._closed:  # no failure of a job whose worker just ended: it goes on after the next start
            raise Canceled("The server is stopping.")
        names = {one.name for one in self._taken}
        name = next(name for number in count(1) if (name := f"{self.name}-{number}") not in names)
        if self._latest is not None and self._latest.is_loaded:
            self._failed_starts = 0
        try:
            worker = self._latest = self._make(name)
        except (OSError, RuntimeError) as error:
            self._note_failure(f"{name} could not be started ({error}).")
            return None
        self.workers.append(worker)
        self._taken[worker] = 0
        return worker

    def _make(self, name: str) -> Worker:
        return Worker(name, self._settings, self._note_end)

    def _clean_up(self) -> None:
        """Lets go of workers that ended without a job, and of the fault where jobs do not wait."""
        for dead in [one for one in self.workers if not one.is_alive and not self._taken[one]]:
            self.workers.remove(dead)
            del self._taken[dead]
            dead.close()
        if any(one.is_loaded and one.is_alive for one in self.workers):
            self.fault = None

    def _note_end(self, worker: Worker, reason: EndReason) -> None:
        """Counts the end of a worker; after one that could not start, the next is started later and later."""
        self._metrics.worker_ends.labels(reason).inc()
        if worker.is_loaded or reason in ("renewed", "stopped"):
            return
        self._note_failure(f"{worker.name} {worker.end_reason} before it had loaded its backends.")

    def _note_failure(self, how: str) -> None:
        pause = min(FIRST_PAUSE_SECONDS * 2**self._failed_starts, LONGEST_PAUSE_SECONDS)
        self._failed_starts, self._next_start = self._failed_starts + 1, time.monotonic() + pause
        often = "" if self._failed_starts == 1 else f" {self._failed_starts} starts have failed."
        fault = f"The worker {how}{often} Another one is started {pause:g} s later; the log says more."
        log.warning("%s", fault)
        if not any(one.is_loaded and one.is_alive for one in tuple(self.workers)):  # else jobs do not wait
            self.fault = fault


class WorkerPool(Computer):
    """All workers of this process."""

    def __init__(self, settings: Settings, metrics: Metrics, artifacts: ArtifactStore) -> None:
        self._settings, self._metrics, self._artifacts = settings, metrics, artifacts
        self._locks, self._memory = KeyLocks(), PrioritySemaphore(memory_for_jobs(settings))
        self._guard = threading.Lock()
        self._groups: dict[str, Group] = {}
        self._closed = threading.Event()
        limit = settings.worker_memory_mb
        self._memory_limit, self._memory_of_all = limit * 1e6 if limit else settings.memory, settings.memory
        self._watching: threading.Thread | None = None

    def start(self) -> None:
        """Starts a worker for the default generator, which loads it, and one for all light ones."""
        if self._watching is not None:
            return
        self._watching = threading.Thread(target=self._watch, name="cow-workers", daemon=True)
        self._watching.start()
        for group in self._default_groups():
            group.fill(first=True)

    def close(self) -> None:
        """Ends all workers."""
        self._closed.set()
        for group in self.groups:
            group.close()
        if self._watching is not None:
            self._watching.join()

    @property
    def groups(self) -> tuple[Group, ...]:
        """The groups that have, or had, workers."""
        with self._guard:
            return tuple(self._groups.values())

    def capacity(self, queue: str) -> int:
        """As many as its workers have places for; none of a queue whose backend cannot run here."""
        # Older versions had a queue for each generator.
        name = queue if places(queue) is not None else queue_of("", queue, self._settings)
        manifest = find_manifest(name)
        if self._settings.ray is None and manifest is not None and manifest.missing_modules():
            return 0  # nodes of a cluster may have what this machine lacks
        group = self._group(name)
        return group.size * group.jobs_each

    def workers(self, active: ActiveJobs) -> tuple[WorkerInfo, ...]:
        """All that are alive."""
        return tuple(
            WorkerInfo(
                name=one.name,
                queue=group.name,
                pid=one.link.pid,
                memory_mb=round(one.memory_bytes / 1e6, 1),
                jobs_done=one.jobs_done,
                jobs=active.describe(one.jobs),
                gpus=one.gpus,
                load=one.load,
            )
            for group in self.groups
            for one in group.alive()
        )

    def load(self, stop: threading.Event | None = None) -> None:
        """Waits until the default backends were loaded once, or until `stop` is set or the pool is closed.

        Raises the `CowError` for which they cannot be loaded. A process that ends before is no such error: another one
        is started in its place.
        """
        for group in self._default_groups():
            while not (group.was_loaded or self._closed.is_set() or (stop is not None and stop.is_set())):
                for worker in tuple(group.workers):
                    is_loaded = worker.is_loaded  # its error is set before
                    if worker.load_error is not None:
                        raise worker.load_error
                    group.was_loaded |= is_loaded
                if not group.was_loaded:
                    self._closed.wait(LOAD_POLL_SECONDS)

    def fault(self) -> str | None:
        """Why jobs wait, where workers cannot start."""
        return next((group.fault for group in self.groups if group.fault is not None), None)

    def compute(self, work: Work) -> JobOutcome:
        """Gives a job to a worker, in its turn. Raises the `CowError` that it fails with, `Canceled`, `WorkerEnded`.

        After a crash, or where its device failed, the job is tried again in another process.
        """
        group = self._group(queue_of(work.job.spec.reader, work.job.spec.generator, self._settings))
        priority = priority_of(work.job.spec.turn, work.job.spec.created_at)
        crashes, alone, check = 0, group.jobs_each == 1, partial(work.progress, None, 0.0)
        needed = memory_needed(work, self._artifacts, self._settings)
        with self._memory.held(priority, check, needed), group.places.held(priority, check):
            while True:
                try:
                    if alone and group.jobs_each > 1:
                        with group.alone:
                            return self._computed(work, group, fresh=True)
                    return self._computed(work, group, fresh=False)
                except DeviceFailed:
                    crashes += 1
                    log.warning("the device of the worker of job %s failed", work.job.id)
                    if crashes >= MAX_CRASHES:
                        raise
                except WorkerGone as gone:
                    if gone.is_blameless:  # the job waits for another worker
                        continue
                    crashes += alone
                    log.warning("the worker of job %s %s", work.job.id, gone)
                    if crashes >= MAX_CRASHES or (alone and gone.is_final):
                        raise WorkerEnded(f"The process that computed the job {gone}. It is not tried again.") from gone
                    alone = True  # the next crash is this job's own

    def _computed(self, work: Work, group: Group, *, fresh: bool) -> JobOutcome:
        worker, renew = group.take(work.check, fresh=fresh), fresh
        try:
            return worker.run(work, self._locks)
        except DeviceFailed:
            renew = True  # the process can use it no more, a new one may
            raise
        finally:
            renew |= worker.jobs_done >= self._settings.worker_jobs
            renew |= worker.memory_bytes > RENEW_SHARE * self._memory_limit
            group.give_back(worker, renew=renew)

    def _default_groups(self) -> list[Group]:
        default = queue_of(self._settings.reader, self._settings.generator, self._settings)
        return [self._group(name) for name in (LIGHT, *({default} - {LIGHT}))]

    def _group(self, name: str) -> Group:
        with self._guard:
            if name not in self._groups:
                self._groups[name] = self._new_group(name)
            return self._groups[name]

    def _new_group(self, name: str) -> Group:
        return Group(name, self._settings, self._metrics)

    def _watch(self) -> None:
        """Ends workers that are frozen or too large, and starts others for those that could not start."""
        looked = time.monotonic()
        while not self._closed.wait(WATCH_SECONDS):
            slept = time.monotonic() - looked > HEARTBEAT_TIMEOUT_SECONDS / 2  # this process was frozen itself
            looked = time.monotonic()
            try:
                for group in self.groups:
                    for worker in [one for one in tuple(group.workers) if one.is_alive]:
                        if slept:
                            worker.heard = looked
                        self._judge(worker, looked)
                    group.fill()
                self._judge_all()
            except Exception:  # it goes on, whatever happens
                log.exception("the workers could not be looked after")

    def _judge(self, worker: Worker, now: float) -> None:
        if not worker.is_loaded and now - worker.started > self._settings.load_timeout:
            limit = f"{self._settings.load_timeout:g} s, which COW_LOAD_TIMEOUT allows"
            worker.kill("load", f"was ended, as it had not started within {limit},")
        elif worker.is_loaded and now - worker.heard > HEARTBEAT_TIMEOUT_SECONDS:
            worker.kill("frozen", f"was ended, as it did not respond for {HEARTBEAT_TIMEOUT_SECONDS:g} s")
        elif worker.memory_bytes > self._memory_limit:
            worker.kill("memory", f"was ended, as it used {worker.memory_bytes / 1e6:.0f} MB, more than it may")

    def _judge_all(self) -> None:
        """Ends the worker whose jobs take most, where all workers together take more than they may."""
        workers = [worker for group in self.groups for worker in group.alive()]
        together, idle = sum(one.memory_bytes for one in workers), sum(one.idle_bytes for one in workers)
        if idle < self._memory_of_all < together:
            largest = max(workers, key=lambda one: one.memory_bytes - one.idle_bytes)
            used = f"all workers used {together / 1e6:.0f} MB, more than COW_MEMORY_MB allows"
            reason = f"was ended, as {used}, and it took most of that for its jobs"
            largest.kill("memory", reason)


def memory_for_jobs(settings: Settings) -> int:
    """Bytes that all jobs may take beside the server and its workers; at least 1, so that a job can run alone."""
    return max(1, int(settings.memory - (settings.concurrency + 1) * WORKER_BYTES))


def memory_needed(work: Work, artifacts: ArtifactStore, settings: Settings) -> int:
    """Bytes that a job will take; those of the largest image where its own cannot be read."""
    spec = work.job.spec
    try:
        pixels = pixels_in(artifacts.read(spec.image))
    except CowError:  # as the worker will find
        pixels = int(settings.max_image_megapixels * 1e6)
    request, of_masks = spec.parsed(), BYTES_PER_PIXEL_OF_A_MASK * len(spec.attached)
    frames = (len(request.frames.indices or ()) or request.frames.count) * (2 if request.interventions else 1)
    side = min(request.frames.max_side or CLIP_SIDE, CLIP_SIDE)
    return pixels * (BYTES_PER_PIXEL + of_masks) + frames * 3 * min(pixels, side**2)
