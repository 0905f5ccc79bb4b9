"""The server of all bridges: slow and several stations, addresses, summaries."""

import asyncio
import errno
import json
import socket
import struct
import threading
import time

import httpx
import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader
from dextouch.errors import DeviceError, InvalidInputError, UnavailableError
from services.acquisition.app import create_app
from services.acquisition.clock import StationClock, station_offset_ns
from services.acquisition.drivers.sdk_link import BridgedDevice, parse_hello
from services.acquisition.sdk_bridges import bridge as bridge_module
from services.acquisition.sdk_bridges.bridge import (
    MAX_STATIONS,
    OUR_AXES,
    QUEUE_PACKETS,
    BridgeServer,
    Pace,
    Reading,
    Source,
    Summary,
    hello,
    pose_reading,
    run_bridge,
)
from services.acquisition.settings import AcquisitionSettings

DEVICE = BridgedDevice(index=0, serial_number="T-1", source="left")
HELLO = hello(kind="pose_tracker", software="a test", devices=(DEVICE,), frame=OUR_AXES)
NUMBERS = (1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3)


class Numbers(Source):
    """Readings that a test makes."""

    clock = "the test's"
    has_station_time = False

    def __init__(self, hello=HELLO):
        super().__init__()
        self.hello, self.failures, self.waiting = hello, [], []

    def open(self):
        if self.failures:
            raise self.failures.pop()
        return self.hello

    def read(self):
        time.sleep(0.001)
        if self.failures:
            raise self.failures.pop()
        waiting, self.waiting = self.waiting, []
        return waiting

    def close(self):
        pass


@pytest.fixture
def listening():
    made = BridgeServer(HELLO, ("127.0.0.1", 0), clock=StationClock())
    yield made
    made.close()


def port_of(server):
    return int(server.address.rpartition(":")[2])


def fail(failures):
    raise failures.pop()


def pose(t_ns):
    return pose_reading(DEVICE, t_ns, NUMBERS)


def until_lost(driver):
    while True:
        driver.read()


def test_a_station_that_does_not_read_delays_nobody(listening, connect, read):
    # The sockets take their buffers' size of a station that never reads; then its queue fills.
    hanging = socket.socket()
    hanging.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    hanging.connect(("127.0.0.1", port_of(listening)))
    driver = connect(kind="pose_tracker", stream="wrist_left", port=port_of(listening))
    longest_s, t_ns = 0.0, 0
    while not listening.summary.dropped:
        before_s = time.thread_time()
        for _ in range(QUEUE_PACKETS // 4):
            t_ns += 10_000_000
            listening.send(pose(t_ns), has_station_time=False)
        longest_s = max(longest_s, time.thread_time() - before_s)
        read(driver)
    assert longest_s < 1.0
    assert driver.statistics.lost == 0
    hanging.close()


def test_what_a_full_queue_loses_is_counted(listening, connect, read):
    connect(kind="pose_tracker", stream="wrist_left", port=port_of(listening))
    with listening._lock:
        (station,) = listening._stations
        # As if its thread did not run.
        station._has_some = threading.Event()
        station._has_some.set = lambda: None
    for count in range(QUEUE_PACKETS + 100):
        listening.send(pose(10_000_000 * (count + 1)), has_station_time=False)
    # Signs of life may have been queued, too.
    assert listening.summary.dropped >= 99
    assert listening.summary.sent == {"T-1": QUEUE_PACKETS + 100}
    assert any("did not read in time" in line for line in listening.summary.lines())


def test_all_stations_count_the_same_packets(listening, connect, read):
    drivers = [
        connect(kind="pose_tracker", stream="wrist_left", port=port_of(listening)) for _ in range(2)
    ]
    for count in range(5):
        listening.send(pose(10_000_000 * (count + 1)), has_station_time=False)
    numbers = [[sample.sequence for sample in read(driver, 5)] for driver in drivers]
    assert numbers[0] == numbers[1] == sorted(set(numbers[0]))
    for driver in drivers:
        assert (driver.statistics.lost, driver.statistics.restarts) == (0, 0)


def test_one_failed_accept_does_not_end_listening(monkeypatch, connect):
    failures = [OSError(errno.EMFILE, "too many open files"), ConnectionAbortedError()]
    accept = socket.socket.accept
    monkeypatch.setattr(
        socket.socket, "accept", lambda one: accept(one) if not failures else fail(failures)
    )
    server = BridgeServer(HELLO, ("127.0.0.1", 0), clock=StationClock())
    connect(kind="pose_tracker", stream="wrist_left", port=port_of(server))
    assert not failures
    server.close()


def test_a_link_that_cannot_be_set_up_is_closed(monkeypatch, listening, connect):
    failures = [OSError(errno.EINVAL, "the station has gone")]
    made = bridge_module.StationLink
    monkeypatch.setattr(
        bridge_module,
        "StationLink",
        lambda *about: made(*about) if not failures else fail(failures),
    )
    with socket.create_connection(("127.0.0.1", port_of(listening)), timeout=10) as link:
        assert link.recv(1) == b""
    connect(kind="pose_tracker", stream="wrist_left", port=port_of(listening))


def test_stamps_that_do_not_advance_are_not_sent(listening):
    second = 10**9
    for t_ns in (5 * second, 5 * second, 4 * second + 1, 6 * second, 1 * second, 2 * second, -1):
        listening.send(pose(t_ns), has_station_time=False)
    # Of a source whose stamps are in ms, not in s.
    listening.send(pose(1_700_000_000_000 * second), has_station_time=False)
    summary = listening.summary
    assert (summary.sent, summary.old, summary.restarts) == ({"T-1": 4}, {"T-1": 4}, {"T-1": 1})


def test_the_delay_is_from_the_stamp_to_the_sending(listening):
    clock = StationClock()
    for delay_ns in (3_000_000, 8_000_000):
        listening.send(pose(clock.now_ns() - delay_ns), has_station_time=True)
        # Stamps must advance.
        time.sleep(0.006)
    least_ms, mean_ms = listening.summary.delay_ms
    assert 3.0 <= least_ms < 8.0
    assert least_ms < mean_ms


def test_only_so_many_stations_are_served(listening):
    address = ("127.0.0.1", port_of(listening))
    links = [socket.create_connection(address) for _ in range(MAX_STATIONS)]
    for link in links:
        assert parse_hello(link.makefile("rb").readline(), device="a test") == HELLO
    with socket.create_connection(address) as refused:
        assert refused.recv(1) == b""
    for link in links:
        link.close()


def test_a_source_without_samples_shows_signs_of_life(serve, connect):
    source = Numbers()
    driver = connect(kind="pose_tracker", stream="wrist_left", port=serve(source).port)
    start = driver.statistics.packets
    while driver.statistics.packets < start + 3:
        assert driver.read() == {}


def test_other_devices_after_a_loss_make_stations_connect_again(serve, connect, read):
    source = Numbers()
    bridge = serve(source)
    driver = connect(kind="pose_tracker", stream="wrist_left", port=bridge.port)
    other = BridgedDevice(index=1, serial_number="T-2", source="left")
    source.hello = hello(kind="pose_tracker", software="a test", devices=(other,), frame=OUR_AXES)
    source.failures.append(DeviceError("the cable was pulled"))
    with pytest.raises(DeviceError, match="closed by the device"):
        until_lost(driver)
    driver.close()
    driver.open()
    source.waiting.append(pose_reading(other, 1, NUMBERS))
    (sample,) = read(driver)
    np.testing.assert_allclose(sample.values, [0.1, 0.2, 0.3, 1, 0, 0, 0], atol=1e-7)
    assert "the cable was pulled; trying again" in bridge.until_said("the cable was pulled")


def test_a_missing_library_ends_the_bridge():
    source = Numbers()
    source.failures.append(UnavailableError("not installed"))
    with pytest.raises(UnavailableError):
        run_bridge(source, ("127.0.0.1", 0), stop=threading.Event(), say=print)


def test_a_local_socket_is_found_again_after_a_kill(serve, connect, read, tmp_path):
    path = tmp_path / "bridge"
    # What a killed bridge leaves behind.
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(str(path))
    source = Numbers()
    bridge = serve(source, path)
    bridge.until_said(str(path))
    driver = connect(kind="pose_tracker", stream="wrist_left", path=str(path))
    source.waiting.append(pose(1))
    read(driver)
    with pytest.raises(InvalidInputError, match="another bridge listens"):
        BridgeServer(HELLO, path, clock=StationClock())
    bridge.end()
    assert not path.exists()


def test_an_address_that_is_no_socket_is_left_alone(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("important")
    with pytest.raises(InvalidInputError, match="cannot listen"):
        BridgeServer(HELLO, path, clock=StationClock())
    assert path.read_text() == "important"


def test_a_port_in_use_is_said(listening):
    with pytest.raises(InvalidInputError, match="choose another --port"):
        BridgeServer(HELLO, ("127.0.0.1", port_of(listening)), clock=StationClock())


def test_the_summary_says_what_was_sent_and_lost():
    summary = Summary(seconds=2.0, dropped=4, not_sent={"unchanged": 7}, delay_ms=(1.5, 2.25))
    summary.sent["T-1"] = 200
    summary.old["T-1"] = 3
    assert summary.lines() == [
        "T-1: 200 samples sent, 100.0 Hz; 3 old, 0 restarts of the clock",
        "not sent: 7 unchanged",
        "lost: 4 packets, because a station did not read in time",
        "from stamp to sending: 1.50 ms at least, 2.25 ms on average",
    ]
    assert json.loads(json.dumps(summary.as_json()))["sent"] == {"T-1": 200}
    assert Summary().lines() == ["no samples"]


class SlewedClock(StationClock):
    """A host whose CLOCK_MONOTONIC was slewed ahead by three seconds, and which slept for two."""

    def read_ns(self, clock_id):
        boot_ns = {
            time.CLOCK_MONOTONIC_RAW: 100 * 10**9,
            time.CLOCK_MONOTONIC: 103 * 10**9,
            time.CLOCK_BOOTTIME: 105 * 10**9,
        }
        return boot_ns[clock_id]


def test_stamps_of_the_slewed_clock_are_converted():
    # Now is 100 s and the 2 s of sleep here, and 103 s there.
    assert station_offset_ns(SlewedClock()) == -(10**9)


def test_an_interrupted_reading_of_the_clocks_is_repeated():
    class Interrupted(SlewedClock):
        extra_ns = iter([0, 5 * 10**9, 5 * 10**9, 5 * 10**9 + 500])

        def now_ns(self):
            return super().now_ns() + next(self.extra_ns, 5 * 10**9)

    # The first attempt took 5 s, the second half a microsecond.
    assert station_offset_ns(Interrupted()) == 4 * 10**9 + 250


async def test_a_take_holds_the_numbers_of_a_bridge(serve, tmp_path):
    device = BridgedDevice(index=0, serial_number="EMG", source="none")
    source = Numbers(
        hello(kind="numbers", software="a test", devices=(device,), frame=OUR_AXES, channels=2)
    )
    port = serve(source).port
    device = {"kind": "numbers", "port": port, "stream": "emg", "shape": (2,), "unit": "uV"}
    settings = AcquisitionSettings(devices=({**device, "rate_hz": 1000},), spool=tmp_path)
    app = create_app(settings)
    sent = {}
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(
            transport=httpx.ASGITransport(app), base_url="http://localhost"
        ) as client,
    ):
        for step, body in (
            ("arm", {"task": "t", "instruction": "do it", "operator": "p7", "consent": True}),
            ("record", None),
        ):
            answer = await client.post(f"/v1/recorder/{step}", json=body)
            assert answer.status_code == 200, answer.text
        recording_id = answer.json()["recording_id"]
        async with asyncio.timeout(30):
            while (await client.get("/v1/recorder")).json()["num_samples"].get("emg", 0) < 50:
                t_ns, values = StationClock().now_ns(), (0.25 * len(sent), -1.0 * len(sent))
                sent[t_ns] = values
                source.waiting = [Reading("EMG", 0, t_ns, struct.pack("<2d", *values))]
                await asyncio.sleep(0.002)
        await client.post("/v1/recorder/stop")
        body = {"success": True, "accept_incomplete": True}
        assert (await client.post("/v1/recorder/save", json=body)).json()["state"] == "saved"
    spool = SpoolReader(tmp_path / recording_id)
    descriptor, batch = spool.streams["emg"], spool.read("emg")
    assert (descriptor.kind, descriptor.unit, descriptor.shape) == ("scalar", "uV", (2,))
    assert len(batch) >= 50
    for t_ns, values in zip(batch.t_device_ns, batch.values, strict=True):
        assert sent[int(t_ns)] == tuple(values)


def test_the_pace_leaves_out_what_has_passed(monkeypatch):
    class Clock(StationClock):
        t_ns = 0

        def now_ns(self):
            return self.t_ns

    clock, slept_s = Clock(), []
    monkeypatch.setattr("services.acquisition.sdk_bridges.bridge.time.sleep", slept_s.append)
    pace = Pace(100.0, clock)
    for clock.t_ns in (0, 12_000_000, 47_000_000):
        pace.wait()
    assert slept_s == pytest.approx([0.010, 0.008, 0.003])
