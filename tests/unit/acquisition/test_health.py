from pathlib import Path

import numpy as np
import pytest
from prometheus_client import CollectorRegistry, generate_latest

from dextouch.streams import Sample
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.camera import camera_descriptor
from services.acquisition.devices.pose_tracker import PoseTrackerDecoder
from services.acquisition.devices.tactile_glove import TactileGloveDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.health.codes import CODES, table
from services.acquisition.health.evaluation import Board, Finding, Hysteresis
from services.acquisition.health.metrics import HealthCollector
from services.acquisition.health.monitor import HealthMonitor
from services.acquisition.health.station import CalibrationCheck, DiskCheck
from services.acquisition.mocks.ports import HidPort, PtyPort
from services.acquisition.station import LiveView
from services.acquisition.supervisor import DeviceSupervisor
from tests.unit.acquisition.health_blocks_made import block, judged

NOTHING = block([])
DOCS = Path(__file__).parents[3] / "docs" / "health.md"
BOOT_NS = 77
CALIBRATION = {
    "tactile_left_tare_counts": ((100.0,) * 360,),
    "tactile_left_gain_counts_per_kpa": ((40.0,) * 360,),
}


class Bench:
    """Two supervised devices whose counters the test moves by hand."""

    def __init__(self):
        self.clock = VirtualClock(10**9)
        drivers = [
            Driver(
                "glove_left",
                transport=PtyPort("a").transport,
                decoder=TactileGloveDecoder("left"),
                clock=self.clock,
            ),
            Driver(
                "pose_tracker_head",
                transport=HidPort("b").transport,
                decoder=PoseTrackerDecoder("head"),
                clock=self.clock,
            ),
        ]
        self.live = LiveView(drivers, CALIBRATION)
        self.supervisors = [
            DeviceSupervisor(driver, sink=self.accept, clock=self.clock) for driver in drivers
        ]
        self.monitor = HealthMonitor(
            self.supervisors, calibration=CALIBRATION, clock=self.clock, station="bench"
        )
        for supervisor in self.supervisors:
            supervisor.connected.set()
        self.counts = np.full(360, 100, np.uint16)

    def accept(self, readings):
        self.live.accept(readings)
        for name, samples in readings.items():
            self.monitor.queues[name].add(samples, self.clock.now_ns())

    def second(self, *, rate=1.0, lost=0, crc=0, evaluate=True):
        values = (self.counts, np.array([0.0, 0, 0, 1, 0, 0, 0]))
        for supervisor, value, rate_hz in zip(self.supervisors, values, (60, 100), strict=True):
            (name,) = supervisor.streams
            start_ns = self.clock.now_ns()
            count = round(rate_hz * rate)
            stamps = (start_ns + np.arange(1, count + 1) * 1_000_000_000 // count).tolist()
            first = supervisor.driver.statistics.packets
            readings = {
                name: [Sample(t, value, t + BOOT_NS, first + k) for k, t in enumerate(stamps)]
            }
            supervisor.count(readings)
            self.accept(readings)
            supervisor.driver.statistics.packets += count
        self.supervisors[0].driver.statistics.lost += lost
        self.supervisors[0].driver.statistics.crc_errors += crc
        self.wait(1.0)
        if evaluate:
            self.monitor.evaluate()

    def wait(self, seconds):
        waiter = self.clock.waiter(drives_time=True)
        waiter.wait_until(self.clock.now_ns() + round(seconds * 1e9))
        waiter.close()

    def levels(self):
        return {s.stream: s.level for s in self.monitor.report().streams}

    def reasons(self):
        return {s.stream: s.reasons for s in self.monitor.report().streams}


@pytest.fixture
def bench():
    return Bench()


def test_silent_devices_are_stale(bench):
    assert bench.levels() == {"tactile_left": "STALE", "head": "STALE"}
    assert bench.monitor.report().level == "STALE"


@pytest.mark.long
def test_a_clean_run_alerts_nobody(bench):
    for _ in range(40):
        bench.second()
        assert bench.levels() == {"tactile_left": "OK", "head": "OK"}
    stream = bench.monitor.report().streams[0]
    assert stream.rate_hz == pytest.approx(60, rel=0.01)
    assert stream.age_s == pytest.approx(0)
    assert stream.received == 2400


def test_silence_shows_within_300_ms(bench):
    bench.second()
    bench.wait(0.1)
    assert bench.levels()["tactile_left"] == "WARN"
    (late,) = bench.monitor.report().streams[0].findings
    assert (late.code, late.lasted_s) == ("late", pytest.approx(0.1))
    bench.wait(0.15)
    assert set(bench.levels().values()) == {"STALE"}


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "level", "word"),
    [
        ({"rate": 0.96}, "WARN", "Hz"),
        ({"rate": 0.8}, "ERROR", "Hz"),
        ({"lost": 1}, "ERROR", "lost"),
        ({"crc": 1}, "ERROR", "damaged"),
    ],
)
def test_faults_raise_after_two_evaluations_and_clear_later(bench, change, level, word):
    for _ in range(11):
        bench.second()
    for _ in range(12):
        bench.second(**change)
    assert bench.levels()["tactile_left"] == level
    assert word in bench.reasons()["tactile_left"][0]
    if "rate" not in change:
        assert bench.levels()["head"] == "OK"
    for _ in range(16):
        bench.second()
    assert bench.levels()["tactile_left"] == "OK"
    assert bench.reasons()["tactile_left"] == ()


def test_dead_taxels_are_counted(bench):
    bench.counts[[3, 77]] = 0
    for _ in range(7):
        bench.second()
    assert bench.levels()["tactile_left"] == "WARN"
    assert bench.reasons()["tactile_left"] == ("2 taxels dead",)
    bench.counts[:30] = 65535
    for _ in range(8):
        bench.second()
    assert bench.levels()["tactile_left"] == "ERROR"
    codes = [f.code for f in bench.monitor.report().streams[0].findings]
    assert codes == ["taxels_saturated", "taxels_dead"]


def test_reconnects_are_mentioned(bench):
    for _ in range(3):
        bench.second()
    bench.supervisors[1].reconnects += 1
    for _ in range(3):
        bench.second()
    assert bench.levels()["head"] == "WARN"
    assert bench.reasons()["head"] == ("1 reconnects",)


def test_hysteresis():
    hysteresis = Hysteresis()
    seen = [hysteresis.update(level) for level in ["WARN", "OK", "WARN", "WARN"] + 5 * ["OK"]]
    assert seen == ["OK", "OK", "OK", "WARN", "WARN", "WARN", "WARN", "WARN", "OK"]


def finding(level, code="loss"):
    return Finding(code, level, level)


def test_a_code_rises_to_the_milder_of_two_and_falls_to_the_graver_of_five():
    board = Board()
    assert board.update([finding("ERROR")], 1) == []
    assert board.is_rising
    assert board.update([finding("WARN")], 2) == [("loss", "WARN")]
    assert board.update([finding("ERROR")], 3) == []
    assert board.update([finding("ERROR"), finding("WARN")], 4) == [("loss", "ERROR")]
    assert not board.is_rising
    changes = [board.update([finding("WARN")], t_ns) for t_ns in range(5, 10)]
    assert changes == [[], [], [], [], [("loss", "WARN")]]
    (active,) = board.active(10)
    assert (active.code, active.level, active.message) == ("loss", "WARN", "WARN")


def test_what_is_raised_says_since_when_and_what_to_do():
    board = Board()
    for second in range(3):
        board.update([finding("WARN")], second * 10**9)
    for second in range(3, 8):
        board.update([finding("ERROR")], second * 10**9)
    (active,) = board.active(8 * 10**9)
    assert (active.level, active.lasted_s) == ("ERROR", 7.0), "since it was first raised"
    assert active.advice == CODES["loss"].advice


def test_every_code_has_one_line_of_advice():
    for code, rule in CODES.items():
        assert rule.advice.endswith("."), code
        assert len(rule.advice) <= 90, code
        assert "\n" not in rule.advice, code


def test_the_docs_hold_the_table_of_codes():
    text = DOCS.read_text(encoding="utf-8")
    assert table() in text, "docs/health.md says how to print what belongs there"


def test_an_evaluation_in_between_raises_and_never_clears():
    board = Board()
    board.update([finding("WARN")], 1)
    assert board.update([finding("WARN"), finding("WARN", "rate")], 2, confirming=True)
    for _ in range(20):
        assert board.update([], 3, confirming=True) == []
    assert [item.code for item in board.active(4)] == ["loss"]


def test_packets_held_back_are_a_finding_a_metric_and_a_count_of_the_device(bench):
    for _ in range(3):
        bench.supervisors[0].driver.statistics.suspects += 2
        bench.second()
    report = bench.monitor.report()
    (found,) = report.streams[0].findings
    assert (found.code, found.level, found.message) == ("suspect", "WARN", "6 packets held back")
    assert report.streams[0].figures["suspect_ratio"] == pytest.approx(0.01)
    assert [device.suspects for device in report.devices] == [6, 0]
    registry = CollectorRegistry()
    registry.register(HealthCollector(bench.monitor.report, bench.monitor.raised))
    text = generate_latest(registry).decode()
    assert 'dextouch_suspect_packets_total{device="glove_left",hand="left"} 6.0' in text


def test_a_packet_that_comes_late_does_not_shrink_the_counter_of_losses(bench):
    """Prometheus takes a counter that shrinks for one that began anew."""
    statistics = bench.supervisors[0].driver.statistics
    registry = CollectorRegistry()
    registry.register(HealthCollector(bench.monitor.report, bench.monitor.raised))
    line = 'dextouch_lost_packets_total{device="glove_left",hand="left"} '
    told = []
    for lost in (3, 2, 4):
        statistics.lost = lost
        (found,) = [x for x in generate_latest(registry).decode().splitlines() if line in x]
        told.append(float(found.removeprefix(line)))
    assert told == [3.0, 3.0, 4.0]


def test_bytes_skipped_after_an_opening_are_no_damage(bench):
    glove = bench.supervisors[0]

    def skip(num_bytes):
        glove.driver.statistics.resync_bytes += num_bytes
        bench.second()
        bench.second()
        return bench.levels()["tactile_left"]

    assert skip(300) == "OK", "it was joined in the middle of a packet"
    glove.reconnects += 1
    bench.second()
    assert skip(300) == "WARN"
    assert bench.reasons()["tactile_left"] == ("1 reconnects",)
    assert skip(300) == "WARN"
    assert "300 bytes skipped between packets" in bench.reasons()["tactile_left"]


def test_a_stale_stream_tells_no_figures(bench):
    for _ in range(3):
        bench.second()
    assert bench.monitor.report().streams[0].figures["rate_hz"] == pytest.approx(60)
    bench.wait(0.3)
    stream = bench.monitor.report().streams[0]
    assert (stream.level, stream.stale, stream.figures, stream.rate_hz) == (
        "STALE",
        "silent",
        {},
        None,
    )


def test_a_lost_device_is_stale_at_once(bench):
    bench.second()
    bench.supervisors[0].connected.clear()
    bench.supervisors[0].last_error = "port vanished"
    stream = bench.monitor.report().streams[0]
    assert (stream.stale, stream.reasons) == ("unplugged", ("port vanished",))
    assert (stream.findings[0].level, stream.findings[0].advice) == (
        "STALE",
        CODES["unplugged"].advice,
    )
    assert bench.levels()["head"] == "OK"


def test_calibration_that_is_missing_or_old_is_told():
    descriptors = [camera_descriptor("camera_head", height_px=8, width_px=8, encoding="rgb8")]
    day_s = 86_400.0

    def found(calibration):
        judge = CalibrationCheck(descriptors, calibration, unix_s=lambda: 10 * day_s)
        return [(f.code, f.level) for f in judged(judge, NOTHING, 0).findings]

    K_head = ((1.0, 0.0, 0.0),) * 3
    assert found({}) == [("calibration_missing", "ERROR")]
    assert found({"K_head": K_head}) == []
    assert found({"K_head": K_head, "calibrated_at_unix_s": ((4 * day_s,),)}) == []
    assert found({"K_head": K_head, "calibrated_at_unix_s": ((2 * day_s,),)}) == [
        ("calibration_age", "WARN")
    ]


@pytest.mark.parametrize("known", [(), ("tare_counts",), ("gain_counts_per_kpa",)])
def test_a_station_starts_with_half_a_calibration_of_a_glove(known):
    calibration = {f"tactile_left_{name}": ((100.0,) * 360,) for name in known}
    decoder = TactileGloveDecoder("left")
    driver = Driver("g", transport=PtyPort("a").transport, decoder=decoder, clock=VirtualClock(1))
    live = LiveView([driver], calibration)
    assert live._gloves == {}
    (finding,) = judged(CalibrationCheck(driver.descriptors, calibration), NOTHING, 0).findings
    assert finding.code == "calibration_missing"
    assert all(f"tactile_left_{name}" not in finding.message for name in known)


@pytest.mark.parametrize(("minutes", "level"), [(40, None), (20, "WARN"), (4, "ERROR")])
def test_the_disk_is_judged_by_the_time_it_lasts(bench, tmp_path, minutes, level):
    rate = 60 * 720 + 100 * 56
    disk = DiskCheck(
        tmp_path,
        bench.supervisors,
        bench.clock.now_ns(),
        free_bytes=lambda: round(minutes * 60 * rate),
    )
    for _ in range(3):
        bench.second()
        verdict = judged(disk, NOTHING, bench.clock.now_ns())
    assert verdict.figures["disk_left_seconds"] == pytest.approx(minutes * 60, rel=1e-3)
    assert [f.level for f in verdict.findings] == ([] if level is None else [level])


def test_metrics_have_the_names_and_labels_that_alerts_use(bench):
    for _ in range(3):
        bench.second(crc=1)
    registry = CollectorRegistry()
    registry.register(HealthCollector(bench.monitor.report, bench.monitor.raised))
    text = generate_latest(registry).decode()
    glove = 'device="glove_left",hand="left"'
    assert f"dextouch_crc_errors_total{{{glove}}} 3.0" in text
    assert f'dextouch_stream_level{{{glove},stream="tactile_left"}} 1.0' in text
    assert f'dextouch_rate_hz{{{glove},stream="tactile_left"}} ' in text
    assert 'dextouch_health_findings_total{code="damage",stream="tactile_left"} 1.0' in text
    bench.wait(1.0)
    text = generate_latest(registry).decode()
    assert f'dextouch_stream_level{{{glove},stream="tactile_left"}} 3.0' in text
    assert "dextouch_rate_hz{" not in text


def test_live_pressures_are_in_kpa_and_never_old(bench):
    bench.counts[:] = 180
    bench.second()
    pressures = bench.live.pressures_kpa(bench.clock.now_ns())
    assert set(pressures) == {"tactile_left"}
    np.testing.assert_allclose(pressures["tactile_left"], 2.0)
    bench.wait(0.6)
    assert bench.live.pressures_kpa(bench.clock.now_ns()) == {}
