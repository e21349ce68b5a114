"""What the service counts, for Prometheus. Each instance has a registry of its own: none knows of another."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_REQUEST_BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600)  # seconds
_STAGE_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600, 1800)  # seconds

QueueDepth = Callable[[], Mapping[tuple[str, str], int]]  # (generator, "queued" | "running") -> how many jobs

log = logging.getLogger("cow_service")


class Metrics:
    """Counters and histograms, from several threads, and gauges that are read on request.

    The job engine sets `queue_depth`.
    """

    def __init__(self) -> None:
        self.queue_depth: QueueDepth | None = None
        self._registry = registry = CollectorRegistry()
        self._requests = Counter(
            "cow_http_requests", "Requests answered.", ("method", "route", "status"), registry=registry
        )
        self._request_seconds = Histogram(
            "cow_http_request_seconds",
            "From a request's head to the last byte of its answer, s.",
            ("route",),
            buckets=_REQUEST_BUCKETS,
            registry=registry,
        )
        self._stage_seconds = Histogram(
            "cow_stage_seconds", "Time in a stage, s.", ("stage",), buckets=_STAGE_BUCKETS, registry=registry
        )
        self._jobs = Counter("cow_jobs", "Jobs that ended.", ("kind", "outcome"), registry=registry)
        self._stage_cache = Counter(
            "cow_stage_cache", "Stages looked for among earlier results.", ("stage", "result"), registry=registry
        )
        ProcessCollector(registry=registry)
        registry.register(_Gauges(self))

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """One HTTP request. `route` is a template, never a path: there must be few of them."""
        self._requests.labels(method, route, str(status)).inc()
        self._request_seconds.labels(route).observe(seconds)

    def stage(self, name: str, seconds: float) -> None:
        """One stage that was computed."""
        self._stage_seconds.labels(name).observe(seconds)

    def job(self, kind: str, outcome: str) -> None:
        """One job (`simulate`, `answer`) that `succeeded`, `failed` or was `canceled`."""
        self._jobs.labels(kind, outcome).inc()

    def stage_cache(self, stage: str, hit: bool) -> None:
        """One stage whose earlier result was looked for."""
        self._stage_cache.labels(stage, "hit" if hit else "miss").inc()

    def exposition(self) -> bytes:
        """Everything in Prometheus' text format, as `MEDIA_TYPE`."""
        return generate_latest(self._registry)


class _Gauges(Collector):
    """Gauges that are computed when the metrics are read."""

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics

    def describe(self) -> Iterable[GaugeMetricFamily]:
        """The gauges without values, so that registering them computes nothing."""
        return (_queue_gauge(), _gpu_gauge())

    def collect(self) -> Iterable[GaugeMetricFamily]:
        """The gauges as of now."""
        for source in (self._queue, _gpu):
            try:
                yield source()
            except Exception as error:  # the other metrics are wanted all the more
                log.error("A metric could not be read", exc_info=error)

    def _queue(self) -> GaugeMetricFamily:
        gauge = _queue_gauge()
        if self._metrics.queue_depth is not None:
            for (generator, state), number in self._metrics.queue_depth().items():
                gauge.add_metric((generator, state), number)
        return gauge


def _queue_gauge() -> GaugeMetricFamily:
    return GaugeMetricFamily("cow_queue_depth", "Jobs that wait or run.", labels=("generator", "state"))


def _gpu_gauge() -> GaugeMetricFamily:
    text = "GPU memory: allocated and reserved by this process, total of the device."
    return GaugeMetricFamily("cow_gpu_memory_bytes", text, labels=("device", "kind"))


def _gpu() -> GaugeMetricFamily:
    """Memory of the GPUs, where this process already uses them: asking starts neither PyTorch nor CUDA."""
    gauge = _gpu_gauge()
    cuda = getattr(sys.modules.get("torch"), "cuda", None)
    if cuda is not None and cuda.is_available() and cuda.is_initialized():
        for index in range(cuda.device_count()):
            device = f"cuda:{index}"
            gauge.add_metric((device, "allocated"), cuda.memory_allocated(index))
            gauge.add_metric((device, "reserved"), cuda.memory_reserved(index))
            gauge.add_metric((device, "total"), cuda.get_device_properties(index).total_memory)
    return gauge
