"""Metrics, alerts and spans of the running containers, in Prometheus and in a collector of OTLP."""

import json
import secrets

import httpx
import pytest

from tests.system.compose_processes import wait_for
from tests.unit.deploy.test_monitoring import ALL as EXPRESSIONS

pytestmark = pytest.mark.containers
OURS = (
    *("acquisition", "episode_store", "alignment", "studies", "dashboard"),
    *("twin", "world_model"),
)
SCRAPED_TIMEOUT_S = 300.0
# A scrape, 30 s of the alert, an evaluation, and a busy machine.
FIRING_TIMEOUT_S = 300.0
# Receives spans as collectors do, decoded by the classes that OpenTelemetry publishes.
COLLECTOR = """
import gzip, json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2 as service
def texts(attributes):
    return {a.key: a.value.string_value or str(a.value.int_value) for a in attributes}
class Collector(BaseHTTPRequestHandler):
    def do_POST(self):
        body = self.rfile.read(int(self.headers["content-length"]))
        if self.headers.get("content-encoding") == "gzip":
            body = gzip.decompress(body)
        found = (self.path, self.headers["content-type"])
        known = found == ("/v1/traces", "application/x-protobuf")
        request = service.ExportTraceServiceRequest.FromString(body if known else b"")
        for one in request.resource_spans:
            resource = texts(one.resource.attributes)
            for span in (span for scope in one.scope_spans for span in scope.spans):
                ids = (span.trace_id.hex(), span.span_id.hex(), span.parent_span_id.hex())
                took_ns = span.end_time_unix_nano - span.start_time_unix_nano
                line = [resource, span.name, *ids, took_ns, texts(span.attributes)]
                print(json.dumps(line), flush=True)
        self.send_response(200 if known else 404)
        self.send_header("content-type", "application/x-protobuf")
        self.end_headers()
        self.wfile.write(service.ExportTraceServiceResponse().SerializeToString())
    def log_message(self, *words):
        pass
ThreadingHTTPServer(("0.0.0.0", 4318), Collector).serve_forever()
"""


@pytest.fixture(scope="module")
def prometheus(composed, note):
    """Ask Prometheus, which runs with the configuration and the rules of the compose file."""
    note(f"prometheus: healthy after {composed.up('prometheus'):.1f} s")

    def prometheus(path, **params):
        url = composed.url("prometheus", 9090) + f"/api/v1/{path}"
        answer = httpx.get(url, params=params, trust_env=False, timeout=30).json()
        assert answer["status"] == "success", answer
        return answer["data"]

    return prometheus


def test_prometheus_scrapes_every_service(composed, prometheus):
    def targets():
        found = prometheus("targets", state="active")["activeTargets"]
        return {one["labels"]["service"]: (one["health"], one["lastError"]) for one in found}

    wait_for(
        "targets",
        SCRAPED_TIMEOUT_S,
        lambda: targets() == dict.fromkeys(OURS, ("up", "")),
        lambda: f"{targets()}\n{composed.log('prometheus')}",
    )


def test_all_rules_and_panels_can_be_evaluated(composed, prometheus, note):
    def rules():
        return [rule for group in prometheus("rules")["groups"] for rule in group["rules"]]

    def evaluated():
        return all(not rule["lastEvaluation"].startswith("0001-") for rule in rules())

    wait_for("rules", SCRAPED_TIMEOUT_S, evaluated, lambda: composed.log("prometheus"))
    wrong = {
        rule["name"]: rule for rule in rules() if rule["health"] != "ok" or "lastError" in rule
    }
    assert not wrong
    empty = [
        place
        for place, expression in EXPRESSIONS
        if not prometheus("query", query=expression)["result"]
    ]
    note(
        f"prometheus: {len(rules())} rules and {len(EXPRESSIONS)} expressions evaluated, "
        f"{len(empty)} of them without data"
    )


def test_services_that_end_are_reported(composed, prometheus):
    def down():
        alerts = prometheus("alerts")["alerts"]
        return {
            alert["labels"]["service"]
            for alert in alerts
            if (alert["labels"]["alertname"], alert["state"]) == ("ServiceDown", "firing")
        }

    def logs():
        return f"{down()}\n{composed.log('prometheus')}"

    assert down() == set()
    # One whose address is written down, and one that is looked up by its name.
    gone = ("studies", "twin")
    try:
        for name in gone:
            composed.stop(name)
        wait_for("alerts", FIRING_TIMEOUT_S, lambda: down() == set(gone), logs)
    finally:
        for name in gone:
            composed.engine.podman("start", name)
    for name in gone:
        composed.wait_healthy(name)
    wait_for("end of the alerts", FIRING_TIMEOUT_S, lambda: not down(), logs)


@pytest.fixture(scope="module")
def spans(composed, disks):
    """All services export spans from now on; those that arrived, by service."""
    flags = ("--read-only", "--cap-drop", "ALL", "--tmpfs", "/tmp")  # noqa: S108 - of the container
    words = ("--name", "collector", "--network", "dextouch:alias=collector", *flags)
    image = ("localhost/dextouch:light", "python", "-c", COLLECTOR)
    composed.engine.podman("run", "--detach", *words, *image)
    composed.variables["OTEL_EXPORTER_OTLP_ENDPOINT"] = "http://collector:4318"
    volumes = {f"/data/{name}": disk.mounted for name, disk in disks.items()}
    composed.down(*OURS)
    for name in [name for name in composed.lasting() if name in OURS]:
        composed.up(name, volumes=volumes)

    def spans():
        lines = composed.engine.podman("logs", "collector").stdout.splitlines()
        return [json.loads(line) for line in lines]

    yield spans
    composed.down("collector")


def test_every_service_exports_its_requests(composed, spans):
    def services():
        return {resource["service.name"] for resource, *_ in spans()}

    wait_for(
        "spans",
        SCRAPED_TIMEOUT_S,
        lambda: len(services()) >= len(OURS),
        lambda: f"{services()}\n{composed.log('collector')}",
    )
    assert services() == set(OURS)


def test_a_trace_goes_through_the_dashboard_to_the_store(composed, key, spans):
    trace_id, parent_id = secrets.token_hex(16), secrets.token_hex(8)
    with httpx.Client(base_url=composed.url("dashboard"), trust_env=False, timeout=60) as browser:
        assert browser.post("/sign_in", data={"key": key}).status_code < 400
        headers = {"traceparent": f"00-{trace_id}-{parent_id}-01"}
        assert browser.get("/v1/episode_store/recordings", headers=headers).is_success

    def ours():
        return {
            resource["service.name"]: (name, span_id, above, took_ns, attributes)
            for resource, name, trace, span_id, above, took_ns, attributes in spans()
            if trace == trace_id
        }

    wait_for("spans", SCRAPED_TIMEOUT_S, lambda: len(ours()) == 2, lambda: f"{ours()}")
    _, dashboard_id, above, outer_ns, of_dashboard = ours()["dashboard"]
    name, _, between, inner_ns, of_store = ours()["episode_store"]
    assert (above, between) == (parent_id, dashboard_id)
    assert (
        of_dashboard["http.response.status_code"] == of_store["http.response.status_code"] == "200"
    )
    assert name == "GET /v1/recordings"
    assert 0 < inner_ns < outer_ns
