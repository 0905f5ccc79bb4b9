"""State of services, disks and queues, from services that answer as the test says."""

import asyncio

import httpx
import pytest
from dashboard_fakes import broken_upstream

from dextouch import __version__
from services.dashboard import system
from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings
from services.dashboard.system import FreeSpace, System, shown_metrics
from services.dashboard.upstream import Upstream

# As written by prometheus_client's exposition, by hand.
METRICS = """\
# HELP process_resident_memory_bytes Resident memory size in bytes.
# TYPE process_resident_memory_bytes gauge
process_resident_memory_bytes 1.5e+08
# TYPE process_start_time_seconds gauge
process_start_time_seconds 1.7e+09
# TYPE process_cpu_seconds_total counter
process_cpu_seconds_total 12.5
# TYPE dextouch_store_free_bytes gauge
dextouch_store_free_bytes 5e+09
# TYPE dextouch_upload_takes gauge
dextouch_upload_takes{state="waiting"} 3.0
dextouch_upload_takes{state="refused"} 1.0
dextouch_upload_takes{state="uploaded"} 70.0
# TYPE dextouch_alignment_jobs gauge
dextouch_alignment_jobs{state="waiting"} 8.0
dextouch_alignment_jobs{state="running"} 1.0
dextouch_alignment_jobs{state="failed"} 0.0
dextouch_alignment_jobs{state="done"} 5.0
dextouch_alignment_open_jobs_limit 9.0
dextouch_rollout_queue_chunks{world="a \\"world\\" }"} 2.0
dextouch_rollout_queue_limit_chunks{world="a \\"world\\" }"} 64.0
dextouch_http_requests_total{route="{{{ broken
"""


class Service:
    """A service of some state; `metrics` may change."""

    def __init__(self, name, *, version=__version__, waiting=(), metrics=METRICS):
        self.name, self.version, self.waiting, self.metrics = name, version, waiting, metrics

    def answer(self, request):
        if request.url.path == "/healthz":
            health = {"status": "ok", "service": self.name, "version": self.version, "new": 1}
            return httpx.Response(200, json=health)
        if request.url.path == "/readyz":
            ready = {"ready": not self.waiting, "service": self.name, "waiting_for": self.waiting}
            return httpx.Response(503 if self.waiting else 200, json=ready)
        return httpx.Response(200, text=self.metrics)

    def upstream(self, host):
        transport = httpx.MockTransport(self.answer)
        client = httpx.AsyncClient(transport=transport, base_url=f"http://user:pass@{host}:1/")
        return Upstream(self.name, client)


def by_name(rows):
    return {row.name: row for row in rows}


async def test_what_each_service_says_is_shown():
    store = Service("episode_store", version="0.0.1")
    align = Service("alignment", waiting=("solver",), metrics="no metrics {")
    upstreams = {"episode_store": store.upstream("a"), "alignment": align.upstream("b")}
    view = await System({"desk": broken_upstream("acquisition")}, upstreams).read()
    assert view.version == __version__
    services = by_name(view.services)
    assert list(services) == ["station desk", "episode store", "alignment"]
    gone, stored, waiting = services.values()
    assert (gone.state, gone.version, gone.latency_s) == ("down", None, None)
    assert "ConnectError" in gone.problem
    assert (stored.state, stored.version, stored.memory_bytes) == ("ready", "0.0.1", 1.5e8)
    assert stored.address == "http://a:1"
    assert stored.uptime_s > 0
    assert stored.latency_s > 0
    assert (waiting.state, waiting.waiting_for) == ("waiting", ("solver",))
    assert waiting.memory_bytes is None


async def test_queues_are_those_of_the_metrics():
    view = await System({}, {"twin": Service("twin").upstream("a")}).read()
    queues = {row.name: (row.count, row.limit, row.level) for row in view.queues}
    assert queues == {
        "uploads waiting": (3, None, "OK"),
        "uploads refused": (1, None, "WARN"),
        "alignments waiting": (8, 8, "WARN"),
        "alignments running": (1, None, "OK"),
        "alignments failed": (0, None, "OK"),
        'chunks waiting for a "world" }': (2, 64, "OK"),
    }


SPOOL = """\
dextouch_upload_takes{state="waiting"} 2.0
dextouch_upload_takes{state="uploaded"} 70.0
dextouch_upload_takes{state="refused"} 1.0
dextouch_spool_bytes{state="waiting"} 3e+09
dextouch_spool_bytes{state="uploaded"} 9e+10
dextouch_spool_bytes{state="refused"} 1e+09
dextouch_spool_keep_seconds 604800.0
"""


@pytest.mark.parametrize(
    ("more", "keep_bytes"), [("", None), ("dextouch_spool_keep_bytes 2e11\n", 2e11)]
)
async def test_spools_say_what_they_hold_and_for_how_long(more, keep_bytes):
    desk = Service("acquisition", metrics=SPOOL + more).upstream("a")
    (spool,) = (await System({"desk": desk}, {"twin": Service("twin").upstream("b")}).read()).spools
    assert spool.name == "station desk"
    assert (spool.waiting_bytes, spool.num_waiting) == (4e9, 3)
    assert (spool.uploaded_bytes, spool.num_uploaded) == (9e10, 70)
    assert (spool.keep_s, spool.keep_bytes) == (7 * 86_400, keep_bytes)


async def test_cpu_is_the_growth_between_two_probes(monkeypatch):
    service = Service("twin")
    now_s = 100.0
    monkeypatch.setattr(system.time, "monotonic", lambda: now_s)
    shown = System({}, {"twin": service.upstream("a")})
    ratios = []
    for cpu_s in (12.5, 14.5, 1.0):  # it was restarted before the last one
        service.metrics = f"process_cpu_seconds_total {cpu_s}\n"
        ratios.append((await shown.read()).services[0].cpu_ratio)
        now_s += 4
    assert ratios == [None, 0.5, None]


async def test_services_of_one_process_are_marked():
    other = Service("world_model", metrics="process_start_time_seconds 1.8e+09\n")
    upstreams = {
        "episode_store": Service("episode_store").upstream("a"),
        "alignment": Service("alignment").upstream("a"),
        "studies": Service("studies").upstream("b"),
        "world_model": other.upstream("a"),
    }
    services = by_name((await System({}, upstreams).read()).services)
    marked = {name for name, one in services.items() if one.shares_process}
    assert marked == {"episode store", "alignment"}


def test_a_disk_that_fills_says_when_it_is_full():
    space = FreeSpace()
    for second in range(0, 121, 2):
        space.add(1000.0 + second, 1e12 - 5e6 * second)
    disk = space.status("store", None)
    assert disk.fill_bytes_per_s == pytest.approx(5e6)
    assert disk.span_s == 120
    assert disk.left_s == pytest.approx((1e12 - 6e8) / 5e6)
    assert disk.level == "OK"


@pytest.mark.parametrize(
    ("free_bytes", "left_s", "level"),
    [(9e9, None, "WARN"), (1e12, 3600.0, "WARN"), (1e12, None, "OK")],
)
def test_a_disk_is_low_by_space_or_time(free_bytes, left_s, level):
    space = FreeSpace()
    space.add(0.0, free_bytes)
    disk = space.status("spool", left_s)
    assert (disk.level, disk.fill_bytes_per_s, disk.left_s) == (level, None, left_s)


def test_a_disk_forgets_what_is_older_than_an_hour():
    space = FreeSpace()
    for second in range(0, 7200, 10):
        space.add(float(second), 1e12 - (1e8 * second if second < 3000 else 3e11))
    assert space.status("store", None).fill_bytes_per_s == 0


def test_only_what_is_shown_is_parsed():
    assert "dextouch_http_requests_total" not in shown_metrics(METRICS)
    with pytest.raises(ValueError, match="float"):
        shown_metrics("process_x { x\n")


async def test_the_route_answers_as_the_topic(upstreams):
    app = create_app(DashboardSettings(), upstreams)
    transport = httpx.ASGITransport(app)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        shown = (await asyncio.wait_for(client.get("/v1/system"), 30)).json()
        assert (await client.get("/system")).status_code == 200
    assert shown["version"] == __version__
    # The fakes have no /healthz.
    assert [one["state"] for one in shown["services"]] == ["down", "down"]
