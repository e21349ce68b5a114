"""What the service counts, for Prometheus. Each instance has its own registry."""

import logging
import sys
from collections import Counter as Counts
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import prometheus_client as prometheus
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from cow_service.records import GpuMemory, WorkerInfo


def gpu_memory() -> tuple[GpuMemory, ...]:
    """Of each GPU, where this process already uses them: asking starts neither PyTorch nor CUDA."""
    cuda = getattr(sys.modules.get("torch"), "cuda", None)
    if cuda is None or not cuda.is_available() or not cuda.is_initialized():
        return ()
    return tuple(
        GpuMemory(
            device=f"cuda:{index}",
            allocated_mb=cuda.memory_allocated(index) / 1e6,
            reserved_mb=cuda.memory_reserved(index) / 1e6,
            total_mb=cuda.get_device_properties(index).total_memory / 1e6,
        )
        for index in range(cuda.device_count())
    )


MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_REQUEST_BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600)  # seconds
_STAGE_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600, 1800)  # seconds

# By name: description, labels.
GAUGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "cow_queue_depth": ("Jobs in the job database that wait or run.", ("queue", "generator", "state")),
    "cow_queue_oldest_seconds": ("Waiting time of the oldest job in a queue, s; 0 if none waits.", ("queue",)),
    "cow_queue_unserved": (
        "Waiting jobs that no process takes, because of their queue or workflow version.",
        ("queue", "reason"),
    ),
    "cow_workers": ("Workers of this process.", ("queue", "state")),
    "cow_worker_memory_bytes": ("Resident memory of a worker.", ("worker",)),
    "cow_gpu_memory_bytes": (
        "GPU memory: allocated and reserved by a worker, total of the device.",
        ("worker", "device", "kind"),
    ),
}
Samples = Iterable[tuple[Sequence[str], float]]  # the values of labels, and the value of the gauge
OWN_PROCESS = ""  # the label `worker` of what this process itself uses
BYTES = 1e6  # of the MB in which records tell memory

log = logging.getLogger("cow_service")


class Metrics(Collector):
    """Counters and histograms, from several threads, and gauges that are read on request.

    The job engine sets `workers`, and in `gauges` what reads those of queues.
    """

    def __init__(self) -> None:
        self.workers: Callable[[], Iterable[WorkerInfo]] = tuple
        self.gauges: dict[str, Callable[[], Samples]] = {
            "cow_workers": self._count_workers,
            "cow_worker_memory_bytes": lambda: [((one.name,), one.memory_mb * BYTES) for one in self.workers()],
            "cow_gpu_memory_bytes": self._measure_gpus,
        }
        self._registry = registry = prometheus.CollectorRegistry()
        counter = partial(prometheus.Counter, registry=registry)
        histogram = partial(prometheus.Histogram, registry=registry)
        self._requests = counter("cow_http_requests", "Requests answered.", ("method", "route", "status"))
        self._request_seconds = histogram(
            "cow_http_request_seconds",
            "Time from a request's head to the last byte of its response, s.",
            ("route",),
            buckets=_REQUEST_BUCKETS,
        )
        self.stage_seconds = histogram("cow_stage_seconds", "Time in a stage, s.", ("stage",), buckets=_STAGE_BUCKETS)
        # The outcome of a job is `succeeded`, `failed` or `canceled`.
        self.jobs = counter("cow_jobs", "Jobs that ended.", ("kind", "outcome"))
        self._stage_cache = counter("cow_stage_cache", "Cache lookups of stages, by result.", ("stage", "result"))
        self.worker_ends = counter("cow_worker_ends", "Worker processes that ended, by reason.", ("reason",))
        self.webhooks = counter("cow_webhook_attempts", "Attempts to call a webhook, by outcome.", ("outcome",))
        self.webhooks_given_up = counter("cow_webhooks_given_up", "Webhooks not delivered after the last attempt.")
        prometheus.ProcessCollector(registry=registry)
        registry.register(self)

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """One HTTP request. `route` is a template, never a path: there must be few of them."""
        self._requests.labels(method, route, str(status)).inc()
        self._request_seconds.labels(route).observe(seconds)

    def stage_cache(self, stage: str, hit: bool) -> None:
        """One stage whose earlier result was looked for."""
        self._stage_cache.labels(stage, "hit" if hit else "miss").inc()

    def serve(self, host: str, port: int) -> None:
        """Serves the exposition over HTTP, on every path, until the process ends. Raises `OSError`."""
        prometheus.start_http_server(port, host, self._registry)

    def exposition(self) -> bytes:
        """Everything in Prometheus' text format, as `MEDIA_TYPE`."""
        return prometheus.generate_latest(self._registry)

    def describe(self) -> Iterable[GaugeMetricFamily]:
        """The gauges without values, so that registering them computes nothing."""
        return [GaugeMetricFamily(name, text, labels=labels) for name, (text, labels) in GAUGES.items()]

    def collect(self) -> Iterable[GaugeMetricFamily]:
        """The gauges as of now."""
        for gauge in self.describe():
            try:
                for values, number in self.gauges.get(gauge.name, tuple)():
                    gauge.add_metric(values, number)
            except Exception as error:  # the other metrics are wanted all the more
                log.error("A metric could not be read", exc_info=error)
            else:
                yield gauge

    def _count_workers(self) -> Samples:
        number: Counts[tuple[str, str]] = Counts()
        for worker in self.workers():
            queue = worker.queue or "all"
            number.update({(queue, "busy"): bool(worker.jobs), (queue, "idle"): not worker.jobs})
        return number.items()

    def _measure_gpus(self) -> Samples:
        of_workers = [(worker.name, gpu) for worker in self.workers() for gpu in worker.gpus]
        for name, gpu in of_workers or [(OWN_PROCESS, gpu) for gpu in gpu_memory()]:
            yield (name, gpu.device, "allocated"), gpu.allocated_mb * BYTES
            yield (name, gpu.device, "reserved"), gpu.reserved_mb * BYTES
            yield (name, gpu.device, "total"), gpu.total_mb * BYTES
