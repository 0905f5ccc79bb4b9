"""Root causes, found in readings that are built by hand."""

from pathlib import Path

import pytest

from dextouch.schemas import DeviceHealth, RaisedFinding, SharedLink, StreamHealth
from services.acquisition.health.causes import SIMULATED_ADVICE, find_causes
from services.acquisition.health.codes import CAUSES, CODES, cause_table
from services.acquisition.health.evaluation import Evaluation
from services.acquisition.health.station import HostCheck
from services.acquisition.supervisor import shared_link
from services.acquisition.transports import TransportInfo

DOCS = Path(__file__).parents[3] / "docs" / "health.md"
HUB = SharedLink(kind="hub", name="1-2")
NETWORK = SharedLink(kind="network", name="192.168.7.20")
BRIDGE = SharedLink(kind="bridge", name="/run/hands.sock")


def finding(code, level="ERROR", lasted_s=3.0, message=None):
    return RaisedFinding(
        code=code,
        level=level,
        message=message or f"{code} found",
        advice=CODES[code].advice,
        lasted_s=lasted_s,
    )


def stream(name, *findings, device=None):
    stale = next((f.code for f in findings if f.level == "STALE"), None)
    return StreamHealth(
        stream=name,
        device=device or f"dev_{name}",
        level=findings[0].level if findings else "OK",
        stale=stale,
        reasons=tuple(f.message for f in findings),
        findings=findings,
        rate_hz=50.0,
        nominal_rate_hz=60.0,
        age_s=0.01,
        received=10,
        lost=0,
    )


def device(name, *, shares=None, simulated=False):
    counts = "packets lost crc_errors length_errors resync_bytes refused reconnects"
    return DeviceHealth(
        device=name,
        shares=shares,
        simulated=simulated,
        connected=True,
        address="",
        last_error=None,
        **dict.fromkeys(counts.split(), 0),
    )


def causes(streams, *, shares=None, simulated=False, station=()):
    shares = shares or {}
    names = dict.fromkeys(item.device for item in streams)
    devices = [device(name, shares=shares.get(name), simulated=simulated) for name in names]
    return find_causes(streams, devices, station)


def brief(found):
    return [(cause.code, cause.streams) for cause in found]


def test_a_healthy_station_has_no_cause():
    assert causes([stream("a"), stream("b")]) == ()


def test_an_overloaded_host_is_one_cause_of_all_that_it_delays():
    streams = [
        stream("a", finding("rate"), finding("gap", "WARN", 9.0)),
        stream("b", finding("clock_residual")),
        stream("c", finding("silent", "STALE", 0.4)),
        stream("d"),
    ]
    wakes = "the station's threads wake 180 ms late (15 tasks on 2 processors)"
    (cause,) = causes(streams, station=[finding("overload", message=wakes)])
    assert (cause.code, cause.level, cause.streams) == ("host", "STALE", ("a", "b", "c"))
    assert cause.message == f"This computer is overloaded: {wakes}"
    assert cause.advice == CODES["overload"].advice
    assert cause.lasted_s == 9.0
    assert set(cause.findings) == {"overload", "rate", "gap", "clock_residual", "silent"}


def test_what_load_does_not_explain_stays_a_fault_of_its_device():
    streams = [
        stream("a", finding("rate"), finding("taxels_dead", "WARN")),
        stream("b", finding("damage")),
        stream("c", finding("silent", "STALE", 30.0), finding("gap")),
    ]
    found = causes(streams, station=[finding("overload")])
    assert brief(found) == [
        ("host", ("a",)),
        ("gone", ("c",)),
        ("device", ("b",)),
        ("device", ("a",)),
    ]
    assert found[2].advice == CODES["damage"].advice


@pytest.mark.parametrize(("num_delayed", "is_host"), [(3, True), (2, False)])
def test_delays_after_the_read_tell_of_the_host_where_most_devices_have_them(num_delayed, is_host):
    delayed = [stream(f"a{k}", finding("latency")) for k in range(num_delayed)]
    found = causes([*delayed, stream("b"), stream("c")])
    assert (found[0].code == "host") is is_host
    assert len(found) == (1 if is_host else num_delayed)


@pytest.mark.parametrize("link", [HUB, NETWORK, BRIDGE])
def test_what_gone_devices_share_is_one_cause(link):
    gone = finding("unplugged", "STALE", 4.0)
    streams = [
        stream("left", gone, finding("rate"), device="glove_left"),
        stream("right", gone, device="glove_right"),
        stream("head"),
    ]
    shares = {"glove_left": link, "glove_right": link}
    (cause,) = causes(streams, shares=shares)
    assert (cause.code, cause.subject) == (link.kind, link.name)
    assert cause.streams == ("left", "right")
    assert cause.advice == CAUSES[link.kind].advice
    assert "glove_left, glove_right" in cause.message


def test_a_hub_with_a_healthy_device_is_not_the_cause():
    gone = finding("unplugged", "STALE", 4.0)
    streams = [stream("a", gone), stream("b", gone), stream("c")]
    found = causes(streams, shares=dict.fromkeys(["dev_a", "dev_b", "dev_c"], HUB))
    assert brief(found) == [("gone", ("a",)), ("gone", ("b",))]


def test_devices_of_a_hub_that_lose_data_together():
    streams = [stream("a", finding("loss")), stream("b", finding("damage")), stream("c")]
    found = causes(streams, shares={"dev_a": HUB, "dev_b": HUB})
    assert brief(found) == [("hub", ("a", "b"))]


def test_the_step_of_a_clock_explains_its_residual_and_its_restart():
    streams = [
        stream("a", finding("clock_residual"), finding("clock_step", "WARN"), device="tracker"),
        stream("b", finding("restart", "WARN"), finding("clock_step", "WARN"), device="tracker"),
    ]
    (cause,) = causes(streams)
    assert (cause.code, cause.subject, cause.level) == ("clock", "tracker", "ERROR")
    assert cause.streams == ("a", "b")
    assert cause.advice == CODES["clock_step"].advice


def test_a_single_device_is_led_by_its_gravest_finding():
    streams = [stream("a", finding("jump", "WARN"), finding("tracking"), device="tracker")]
    (cause,) = causes(streams)
    assert (cause.code, cause.level) == ("device", "ERROR")
    assert cause.message == "tracker: tracking found"
    assert cause.advice == CODES["tracking"].advice


def test_findings_of_the_station_are_causes_without_streams():
    (cause,) = causes([stream("a")], station=[finding("disk", "WARN")])
    assert (cause.code, cause.subject, cause.streams) == ("station", "disk", ())
    assert cause.advice == CODES["disk"].advice


@pytest.mark.parametrize("code", ["unplugged", "clock_step", "loss", "taxels_dead"])
def test_mocks_get_no_advice_about_cables(code):
    level = "STALE" if code == "unplugged" else "ERROR"
    (cause,) = causes([stream("a", finding(code, level))], simulated=True)
    assert cause.advice == SIMULATED_ADVICE


def test_simulated_devices_that_share_a_bridge_get_none_either():
    gone = finding("unplugged", "STALE", 4.0)
    (cause,) = causes(
        [stream("a", gone, device="a"), stream("b", gone, device="b")],
        shares={"a": BRIDGE, "b": BRIDGE},
        simulated=True,
    )
    assert (cause.code, cause.advice) == ("bridge", SIMULATED_ADVICE)


def test_the_docs_hold_the_table_of_causes():
    text = DOCS.read_text(encoding="utf-8")
    assert cause_table() in text, "docs/health.md says how to print what belongs there"


def wakes(late_ms):
    judge, now_ns = HostCheck(lambda: (15.2, 2)), 0
    for late in late_ms:
        now_ns += round((100 + late) * 1e6)
        judge.note(now_ns, round(late * 1e6))
    evaluation = Evaluation(now_ns)
    judge(evaluation)
    return evaluation


@pytest.mark.parametrize(
    ("late_ms", "level"),
    [(1, None), (19, None), (25, "WARN"), (99, "WARN"), (150, "ERROR"), (700, "ERROR")],
)
def test_threads_that_wake_late_are_an_overload(late_ms, level):
    evaluation = wakes([late_ms] * 100)
    assert [found.level for found in evaluation.findings] == ([level] if level else [])
    assert evaluation.figures["host_wake_p90_seconds"] == pytest.approx(late_ms * 1e-3)
    if level:
        text = f"the station's threads wake {late_ms} ms late (15 tasks on 2 processors)"
        assert evaluation.findings[0].message == text


def test_one_sleep_of_the_computer_is_no_overload():
    assert wakes([1] * 60 + [3_600_000] + [1] * 39).findings == []


def test_few_wakes_say_nothing():
    assert wakes([25] * 30).findings == []
    assert wakes([500] * 8).findings == []


def test_a_starved_computer_is_one_cause_of_what_it_delays_however_late_its_threads_are():
    streams = [
        stream("keypoints_left", finding("loss"), finding("latency")),
        stream("tactile_left", finding("gap"), finding("silent", "STALE", 0.4)),
    ]
    found = wakes([400] * 25).findings
    station = [finding(one.code, one.level, message=one.message) for one in found]
    assert brief(causes(streams, station=station)) == [("host", ("keypoints_left", "tactile_left"))]


@pytest.fixture
def sysfs(tmp_path):
    ports = {"ttyACM0": "1-2/1-2.4", "ttyACM1": "1-3", "ttyS0": "serial8250"}
    for name, port in ports.items():
        place = tmp_path / "devices" / "usb1" / port / "tty" / name
        place.mkdir(parents=True)
        link = tmp_path / "tty" / name / "device"
        link.parent.mkdir(parents=True)
        link.symlink_to(place)
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "address", "shared"),
    [
        ("serial", "/dev/ttyACM0", ("hub", "1-2")),
        ("serial", "/dev/ttyACM1", None),
        ("serial", "/dev/ttyS0", None),
        ("serial", "not opened", None),
        ("socket", "192.168.7.20:9000", ("network", "192.168.7.20")),
        ("socket", "127.0.0.1:9000", ("bridge", "127.0.0.1:9000")),
        ("socket", "/run/hands.sock", ("bridge", "/run/hands.sock")),
        ("socket", "mock:glove_left", None),
        ("usb", "0483:5740", None),
    ],
)
def test_what_a_device_shares_is_read_from_its_address(sysfs, kind, address, shared):
    found = shared_link(TransportInfo(kind, address), sysfs=sysfs)
    assert (None if found is None else (found.kind, found.name)) == shared
