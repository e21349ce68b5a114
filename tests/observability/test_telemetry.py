"""What the operator sees: ids on responses and in logs, metrics, and traces that a collector takes."""

from __future__ import annotations

import io
import json
import logging
import re
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from asgi import app_of, ask
from fastapi import FastAPI
from fastapi.responses import StreamingResponse
from prometheus_client.parser import text_string_to_metric_families
from servers import Served
from starlette.testclient import TestClient

from cow_service.api.app import create_app
from cow_service.api.middleware.access import Origins, hash_of
from cow_service.errors import install_line
from cow_service.jobs.engine import JobEngine
from cow_service.observability import logging as context
from cow_service.observability import logging as logs
from cow_service.observability import tracing
from cow_service.observability.metrics import Metrics
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError

pytestmark = pytest.mark.slow

TRACE, SPAN = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
PARENT = f"00-{TRACE}-{SPAN}-01"
SHA = "0" * 64


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return app_of(tmp_path_factory.mktemp("telemetry"))


# --- ids ---


def test_a_request_id_is_kept_unless_it_could_harm_a_log(app: FastAPI) -> None:
    for given in ("a", "Req_1.2-3", "x" * 128):
        for response in ask(app, ("GET", "/livez", {"X-Request-Id": given}), ("GET", "/x", {"X-Request-Id": given})):
            assert response.headers["x-request-id"] == given
    harmful = [{"X-Request-Id": given.encode("latin-1")} for given in ("", "a b", "x" * 129, "a\tb", "<a>", "ä")]
    made = [one.headers["x-request-id"] for one in ask(app, *(("GET", "/livez", headers) for headers in harmful))]
    assert all(re.fullmatch("[0-9a-f]{32}", one) for one in made)
    assert len(set(made)) == len(harmful)


def test_a_trace_goes_on_or_begins(app: FastAPI) -> None:
    known, other, none = ask(
        app,
        ("GET", "/livez", {"traceparent": PARENT}),
        ("GET", "/livez", {"traceparent": f"00-{'0' * 32}-{SPAN}-01"}),
        ("GET", "/livez"),
    )
    _, trace_id, span_id, flags = known.headers["traceparent"].split("-")
    assert (trace_id, flags) == (TRACE, "01")
    assert span_id not in (SPAN, "0" * 16)
    for response in (other, none):
        begun = re.fullmatch("00-([0-9a-f]{32})-[0-9a-f]{16}-00", response.headers["traceparent"])
        assert begun
        assert begun[1] not in (TRACE, "0" * 32)


def test_faults_carry_the_ids_too(
    service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("secret")

    app = create_app(JobEngine(service))
    monkeypatch.setattr(service, "models", fail)
    in_route = ask(app, ("GET", "/models", {"X-Request-Id": "one"}))[0]
    monkeypatch.setattr(Origins, "refuse", fail)
    in_layer = ask(create_app(JobEngine(service)), ("GET", "/livez", {"X-Request-Id": "two"}))[0]
    for response, given in ((in_route, "one"), (in_layer, "two")):
        assert response.status_code == 500
        assert response.json()["type"] == "urn:cow:problem:internal-error"
        assert response.headers["x-request-id"] == given
        assert response.headers["x-content-type-options"] == "nosniff"
        assert re.fullmatch("00-[0-9a-f]{32}-[0-9a-f]{16}-0[01]", response.headers["traceparent"])
        assert "secret" not in response.text
    assert len([record for record in caplog.records if record.exc_info]) == 2


def test_an_answer_that_breaks_off_is_not_taken_for_whole(tmp_path: Path) -> None:
    app = app_of(tmp_path)

    @app.get("/broken")
    async def broken() -> StreamingResponse:
        async def parts() -> object:
            yield b"half"
            raise ZeroDivisionError

        return StreamingResponse(parts())

    with pytest.raises(ZeroDivisionError):  # the server breaks the connection off
        TestClient(app).get("/broken")


# --- metrics ---


def samples(metrics: Metrics | str) -> dict[tuple[str, tuple[str, ...]], float]:
    """Values by name and label values, in the order of the label names."""
    text = metrics if isinstance(metrics, str) else metrics.exposition().decode()
    return {
        (sample.name, tuple(sample.labels[name] for name in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_requests_are_counted_by_the_template_of_their_route(tmp_path: Path) -> None:
    app = app_of(tmp_path, api_keys={"alice": hash_of("cow_alice")}, rate_limit=4)
    key = {"Authorization": "Bearer cow_alice"}
    ask(
        app,
        ("GET", "/livez"),
        ("GET", "/jobs/a_1", key),
        ("GET", "/jobs/a_2", key),
        ("GET", "/jobs/a_1"),
        ("GET", "/nowhere/42", key),
        ("BREW", "/livez"),
    )
    response, late = ask(app, ("GET", "/metrics", key), ("GET", "/jobs/a_1", key))
    assert late.status_code == 429
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    seen = samples(response.text)
    for labels, number in {
        ("GET", "/livez", "200"): 1,
        ("GET", "/jobs/{id}", "422"): 2,
        ("GET", "/jobs/{id}", "401"): 1,
        ("GET", "unmatched", "404"): 1,
        ("other", "/livez", "401"): 1,
    }.items():
        assert seen["cow_http_requests_total", labels] == number
    assert seen["cow_http_request_seconds_count", ("/jobs/{id}",)] == 3
    assert "/jobs/a" not in response.text
    assert "nowhere" not in response.text
    assert ask(app, ("GET", "/metrics"))[0].status_code == 401
    if sys.platform == "linux":
        assert seen["process_resident_memory_bytes", ()] > 0


def test_a_gauge_that_cannot_be_read_leaves_the_others(caplog: pytest.LogCaptureFixture) -> None:
    metrics = Metrics()
    metrics.stage_cache("generation", hit=False)
    metrics.gauges["cow_queue_depth"] = lambda: [(("light", "ati", "queued"), 3)]
    assert samples(metrics)["cow_queue_depth", ("ati", "light", "queued")] == 3

    def fail() -> None:
        raise OSError("the database is gone")

    metrics.gauges["cow_queue_depth"] = fail
    assert samples(metrics)["cow_stage_cache_total", ("miss", "generation")] == 1
    assert "the database is gone" in caplog.text


def test_gpu_memory_is_told_where_the_process_uses_one(monkeypatch: pytest.MonkeyPatch) -> None:
    used = SimpleNamespace(
        is_available=lambda: True,
        is_initialized=lambda: True,
        device_count=lambda: 1,
        memory_allocated=lambda _: 10,
        memory_reserved=lambda _: 20,
        get_device_properties=lambda _: SimpleNamespace(total_memory=30),
    )
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=used))
    seen = samples(Metrics())
    kinds = {"allocated": 10, "reserved": 20, "total": 30}
    assert {kind: seen["cow_gpu_memory_bytes", ("cuda:0", kind, "")] for kind in kinds} == kinds
    used.is_initialized = lambda: False
    assert not [name for name, _ in samples(Metrics()) if name == "cow_gpu_memory_bytes"]


# --- logs ---


@pytest.fixture
def written() -> Iterator[SimpleNamespace]:
    """Logs set up on two texts; what was set up before comes back."""
    names = ("", "uvicorn", "uvicorn.error", "cow_service", logs.ACCESS)
    loggers = [logging.getLogger(name) for name in names]
    before = [(each.handlers, each.level, each.propagate, each.filters) for each in loggers]
    streams = SimpleNamespace(out=io.StringIO(), err=io.StringIO())

    def set_up(**settings: str) -> None:
        logs.set_up(Settings(**settings), out=streams.out, err=streams.err)

    streams.set_up = set_up
    yield streams
    logging.captureWarnings(False)
    for logger, (handlers, level, propagate, filters) in zip(loggers, before, strict=True):
        logger.handlers, logger.propagate, logger.filters = handlers, propagate, filters
        logger.setLevel(level)


def test_text_is_one_line_a_record(written: SimpleNamespace) -> None:
    written.set_up()
    written.set_up()  # once more changes nothing
    with context.bound(request="r1", job="j1"):
        logging.getLogger("cow_service").info("a %s", "b\nINFO forged")
        logging.getLogger("cow_service").debug("too little")
    logging.getLogger("uvicorn.error").info("Uvicorn running on %s", "http://127.0.0.1:8000")
    try:
        raise ValueError("why")
    except ValueError:
        logging.getLogger("cow_service").exception("failed")
    first, second, third, *trace = written.err.getvalue().splitlines()
    assert re.fullmatch(
        r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d INFO cow_service: a b\\nINFO forged request_id=r1 job_id=j1", first
    )
    assert second.endswith("INFO uvicorn: Uvicorn running on http://127.0.0.1:8000")
    assert third.endswith("ERROR cow_service: failed")
    assert trace[-1] == "ValueError: why"
    logging.getLogger(logs.ACCESS).info("GET /")
    assert written.out.getvalue().endswith("INFO cow_service.access: GET /\n")
    assert "GET /" not in written.err.getvalue()


def test_json_is_one_object_a_line(written: SimpleNamespace) -> None:
    written.set_up(log_format="json", log_level="debug")
    with tracing.span("job", parent=PARENT), context.bound(request="r1", job="j1"):
        logging.getLogger("cow_service.jobs").debug("ü\n", extra={"path": Path("/x"), "n": 1, "message_": None})
    try:
        raise ValueError("why")
    except ValueError:
        logging.getLogger("somebody.else").exception("failed")
    first, second = (json.loads(line) for line in written.err.getvalue().splitlines())
    ids = {"request_id": "r1", "job_id": "j1", "trace_id": TRACE, "span_id": SPAN}
    told = {"level": "debug", "logger": "cow_service.jobs", "message": "ü\n", "path": "/x", "n": 1}
    assert first == ids | told | {"time": first["time"]}
    assert first["time"].endswith("Z")
    assert datetime.fromisoformat(first["time"]).utcoffset().total_seconds() == 0
    assert second["exception"].endswith("ValueError: why")
    assert set(second) == {"time", "level", "logger", "message", "exception"}


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_a_line_has_an_end_whatever_was_sent(written: SimpleNamespace, log_format: str) -> None:
    written.set_up(log_format=log_format)
    sent = "first " + "x" * 1_000_000 + " last"
    try:
        raise ValueError(sent)
    except ValueError:
        with context.bound(request="r1"):
            logging.getLogger("cow_service").exception("failed", extra={"sent": sent})
            logging.getLogger("cow_service").warning("%s", sent)
    traced, told = (text for text in re.split(r"\n(?={|\d{4}-)", written.err.getvalue()))
    assert max(map(len, written.err.getvalue().splitlines())) < 3 * logs.MAX_TEXT
    assert "failed" in traced
    assert "first" in told
    assert "r1" in told
    for text in (traced, told):
        assert "characters]" in text
        assert "last" in text


# --- a real server, with everything on ---


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A `cow serve` that logs JSON and exports traces: its answers, its log, and what the collector took."""
    from otlp import Collector

    with Collector() as collector:
        own = {
            "COW_LOG_FORMAT": "json",
            "COW_API_KEYS": json.dumps({"alice": hash_of("cow_alice")}),
            "OTEL_EXPORTER_OTLP_ENDPOINT": collector.address,
            "OTEL_RESOURCE_ATTRIBUTES": "deployment.environment=test",
        }
        with Served(tmp_path_factory.mktemp("telemetry"), **own) as one:
            key = {"Authorization": "Bearer cow_alice"}
            asked = [
                ("/models", key | {"X-Request-Id": "first", "traceparent": PARENT}),
                (f"/artifacts/{SHA}?secret=1", key | {"X-Request-Id": "second"}),
                ("/livez", {"traceparent": PARENT[:-2] + "00"}),
                ("/models", {}),
            ]
            answers = [one.http.get(path, headers=headers) for path, headers in asked]
            one.stop()
            lines = [json.loads(line) for line in one.log().splitlines()]
    return SimpleNamespace(answers=answers, lines=lines, log=one.log(), collector=collector)


def test_one_access_line_a_request_with_its_ids(run: SimpleNamespace) -> None:
    assert "Application shutdown complete." in [line["message"] for line in run.lines]
    lines = [line for line in run.lines if line["logger"] == "cow_service.access"]
    lines = [line for line in lines if line["path"] != "/readyz"]  # of the start
    assert [(line["path"], line["status"], line.get("owner")) for line in lines] == [
        ("/models", 200, "alice"),
        (f"/artifacts/{SHA}", 404, "alice"),
        ("/livez", 200, None),
        ("/models", 401, None),
    ]
    for line, answer in zip(lines, run.answers, strict=True):
        assert line["method"] == "GET"
        assert line["milliseconds"] >= 0
        assert line["request_id"] == answer.headers["x-request-id"]
        assert (line["trace_id"], line["span_id"]) == tuple(answer.headers["traceparent"].split("-")[1:3])
    assert "secret" not in run.log
    assert "cow_alice" not in run.log


def test_a_collector_takes_a_span_for_each_request(run: SimpleNamespace) -> None:
    from otlp import value

    assert run.collector.paths == {"/v1/traces"}
    assert run.collector.resources[0]["service.name"] == "cow"
    assert run.collector.resources[0]["deployment.environment"] == "test"
    spans = {span.span_id.hex(): span for span in run.collector.spans if span.name != "GET /readyz"}  # of the start
    here = [answer.headers["traceparent"].split("-") for answer in run.answers]
    assert set(spans) == {span for _, _, span, flags in here if flags == "01"}  # not the one that its caller left out
    first, second, refused = (spans[here[place][2]] for place in (0, 1, 3))
    assert (first.trace_id.hex(), first.parent_span_id.hex(), first.name) == (TRACE, SPAN, "GET /models")
    assert first.kind == first.SPAN_KIND_SERVER
    assert not second.parent_span_id
    attributes = {each.key: value(each.value) for each in second.attributes}
    assert attributes == {
        "http.request.method": "GET",
        "http.response.status_code": 404,
        "http.route": "/artifacts/{sha256}",
        "url.path": f"/artifacts/{SHA}",
        "cow.owner": "alice",
    }
    assert refused.name == "GET /models"


# --- traces ---


def test_spans_nest_and_are_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    from otlp import Collector, value

    with Collector() as collector:
        environment = {"OTEL_EXPORTER_OTLP_TRACES_ENDPOINT": collector.address + "/here"}
        monkeypatch.setenv(*next(iter(environment.items())))
        assert tracing.start(environment)
        try:
            with tracing.request_span("GET", PARENT):
                request = context.traceparent()
                with tracing.span("stage", **{"cow.stage": "grounding", "cow.none": None}):
                    inner = context.ids()
                assert context.traceparent() == request
                tracing.describe("GET /x", failed=True, status=500)
            with tracing.span("job", parent=request):
                job = context.ids()
            with pytest.raises(KeyError), tracing.span("fails"):
                raise KeyError("k")
        finally:
            tracing.stop()
        assert not tracing.start({})
    spans = {span.name: span for span in collector.spans}
    assert collector.paths == {"/here"}
    assert set(spans) == {"GET /x", "stage", "job", "fails"}
    assert spans["stage"].parent_span_id == spans["GET /x"].span_id == spans["job"].parent_span_id
    assert {span.trace_id.hex() for name, span in spans.items() if name != "fails"} == {TRACE}
    assert (inner["span_id"], job["span_id"]) == (spans["stage"].span_id.hex(), spans["job"].span_id.hex())
    assert {each.key: value(each.value) for each in spans["stage"].attributes} == {"cow.stage": "grounding"}
    assert spans["GET /x"].status.code == spans["fails"].status.code == 2


def test_traces_that_cannot_be_sent_stop_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    for environment, named in (
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "collector:4318"}, "OTEL_EXPORTER_OTLP_ENDPOINT"),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://c", "OTEL_EXPORTER_OTLP_PROTOCOL": "grpc"}, "http/protobuf"),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://c"}, install_line("otel")),
    ):
        with pytest.raises(SettingsError) as caught:
            tracing.start(environment)
        assert named in str(caught.value)
        for off in ({"OTEL_SDK_DISABLED": "true"}, {"OTEL_TRACES_EXPORTER": "none"}):
            assert not tracing.start(environment | off)
