"""Numbers of a real Lab Streaming Layer outlet of this process, by liblsl, at a station."""

import time
import uuid

import numpy as np
import pytest

from dextouch.errors import DeviceError, InvalidInputError
from services.acquisition.clock import StationClock
from services.acquisition.sdk_bridges.lsl_stream import LslStream

pylsl = pytest.importorskip("pylsl", reason="pylsl is not installed (extra `bridges`)")

CHANNELS = 7


class Outlet:
    """An outlet of this process that is no other test's."""

    def __init__(self, name, *, channels=CHANNELS, channel_format=None, source_id=None):
        source_id = source_id or uuid.uuid4().hex
        info = pylsl.StreamInfo(
            name, "test", channels, 100.0, channel_format or pylsl.cf_double64, source_id
        )
        self.source_id, self.lsl = source_id, pylsl.StreamOutlet(info)
        self.pushed = []

    def push(self, values, stamp_s=None):
        stamp_s = pylsl.local_clock() if stamp_s is None else stamp_s
        self.lsl.push_sample(list(values), stamp_s)
        self.pushed.append((stamp_s, values))


@pytest.fixture(autouse=True)
def _short_search(monkeypatch):
    monkeypatch.setattr("services.acquisition.sdk_bridges.lsl_stream.RESOLVE_S", 0.3)


@pytest.fixture
def name():
    return f"dextouch test {uuid.uuid4().hex}"


def numbers(port, **settings):
    declared = {"shape": (CHANNELS,), "unit": "uV", "rate_hz": 100, "stream": "emg", **settings}
    return {"kind": "numbers", "port": port, **declared}


@pytest.fixture
def pushing(read):
    """Reads samples of a driver while an outlet pushes random ones."""
    rng = np.random.default_rng(1)

    def pushing(outlet, driver, count, *, stamp_s=lambda: None):
        def push():
            outlet.push(rng.normal(size=CHANNELS), stamp_s())
            time.sleep(0.002)

        return read(driver, count, after=push)

    return pushing


def test_numbers_and_stamps_arrive_as_they_were_pushed(name, serve, connect, pushing):
    outlet, clock = Outlet(name), StationClock()
    driver = connect(**numbers(serve(LslStream(name)).port))
    samples = pushing(outlet, driver, 20)
    by_values = {tuple(values): stamp_s for stamp_s, values in outlet.pushed}
    # liblsl's clock is CLOCK_MONOTONIC; where it stands against the station's is read here again.
    offset_ns = clock.now_ns() - time.monotonic_ns()
    for sample in samples:
        stamp_ns = by_values[tuple(sample.values)] * 1e9 + offset_ns
        # Outlet and inlet share a clock: the offset that liblsl measures is its own error.
        assert abs(sample.t_device_ns - stamp_ns) < 5e6
        assert sample.t_device_ns <= sample.t_host_ns + 5e6


def test_the_offset_of_the_clocks_is_added(name, serve, connect, pushing, monkeypatch):
    """As of an outlet on a computer that was started a thousand seconds later."""
    behind_s = 1000.0
    from pylsl.lib import lib

    def correction(inlet, remote_s, uncertainty_s, timeout_s, code):
        uncertainty_s._obj.value = 0.25e-3
        return behind_s

    monkeypatch.setattr(lib, "lsl_time_correction_ex", correction)
    source, outlet = LslStream(name), Outlet(name)
    driver = connect(**numbers(serve(source).port))
    samples = pushing(outlet, driver, 5, stamp_s=lambda: pylsl.local_clock() - behind_s)
    for sample in samples:
        assert abs(sample.t_host_ns - sample.t_device_ns) < 5e9
    assert source.report() == [
        "offset of the outlet's clock: 1000.000000 s, uncertain by 0.25 ms at most"
    ]


@pytest.mark.parametrize("channel_format", ["cf_float32", "cf_int16", "cf_int32"])
def test_other_formats_become_float64(name, serve, connect, read, channel_format):
    outlet = Outlet(name, channel_format=getattr(pylsl, channel_format))
    driver = connect(**numbers(serve(LslStream(name)).port))

    def push():
        outlet.push([-3, -2, -1, 0, 1, 2, 3])
        time.sleep(0.002)

    (sample, *_) = read(driver, after=push)
    assert sample.values.dtype == np.float64
    np.testing.assert_array_equal(sample.values, [-3, -2, -1, 0, 1, 2, 3])


async def test_a_pose_outlet_at_the_route_of_a_station(name, serve, live_poses):
    outlet = Outlet(name)
    bridge = serve(LslStream(outlet.source_id, by="source_id"))
    half = np.sqrt(0.5)

    class Pushing:
        """Pushes whenever the station is asked."""

        def __iter__(self):
            outlet.push([1.0, 2.0, 3.0, half, half, 0.0, 0.0])
            return iter(("wrist_left",))

    found = await live_poses(
        numbers(
            bridge.port,
            stream="wrist_left",
            stream_kind="pose",
            unit="pose_m_wxyz",
            frame="world",
            side="left",
        ),
        streams=Pushing(),
    )
    # A quarter turn about x, by hand: y to z.
    expected = [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(found["wrist_left"], expected, atol=1e-12)


def test_stamps_that_go_back_are_not_sent_and_a_restarted_clock_is(name, serve, connect, pushing):
    outlet = Outlet(name)
    bridge = serve(LslStream(name))
    driver = connect(**numbers(bridge.port))
    first = pushing(outlet, driver, 3)
    start_s = pylsl.local_clock()
    # A twentieth of a second ago: a repetition.
    for _ in range(3):
        outlet.push(np.zeros(CHANNELS), start_s - 0.05)
    # Before this computer was started, which no packet can say.
    outlet.push(np.zeros(CHANNELS), -1e6)
    # No time at all.
    outlet.push(np.zeros(CHANNELS), np.nan)
    outlet.push(np.zeros(CHANNELS), np.inf)
    # Half of the time since then, and on from there: another clock.
    stamps = iter(start_s / 2 + 0.002 * np.arange(10_000))
    again = pushing(outlet, driver, 3, stamp_s=lambda: next(stamps))
    assert again[0].t_device_ns < first[-1].t_device_ns - 0.4e9 * start_s
    assert not any((sample.values == 0).all() for sample in again)
    summary = bridge.end()
    assert summary.old[name] == 6
    assert summary.restarts[name] == 1


def test_an_outlet_that_comes_back_is_found_again(name, serve, connect, pushing):
    outlet = Outlet(name)
    bridge = serve(LslStream(name))
    driver = connect(**numbers(bridge.port))
    pushing(outlet, driver, 2)
    outlet.lsl = None
    bridge.until_said("is lost")
    successor = Outlet(name)
    pushing(successor, driver, 2)


def test_an_outlet_of_words_is_refused(name):
    _outlet = Outlet(name, channels=1, channel_format=pylsl.cf_string)
    with pytest.raises(InvalidInputError, match="markers in words"):
        LslStream(name).open()


def test_two_outlets_of_one_name_are_told_apart(name):
    outlets = [Outlet(name), Outlet(name)]
    with pytest.raises(InvalidInputError, match="--by source_id") as caught:
        LslStream(name).open()
    assert all(outlet.source_id in caught.value.message for outlet in outlets)


def test_an_absent_outlet_is_another_try(name):
    with pytest.raises(DeviceError, match="no outlet whose name"):
        LslStream(name).open()


def test_another_shape_is_refused_by_the_station(name, serve, connect):
    _outlet = Outlet(name)
    port = serve(LslStream(name)).port
    with pytest.raises(DeviceError, match="sends 7 numbers a sample, expected 4"):
        connect(**numbers(port, shape=(2, 2)))


def test_outlets_are_listed(name):
    outlet = Outlet(name)
    (line,) = [line for line in LslStream("").present() if name in line]
    assert f"source_id {outlet.source_id}, 7 channels, 100 Hz" in line
