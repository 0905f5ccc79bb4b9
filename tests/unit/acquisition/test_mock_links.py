"""A mock station's devices by every link and protocol, on the drivers of real stations."""

import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader
from dextouch.errors import DeviceError
from dextouch.schemas import TakePrompt
from services.acquisition.app import create_app
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.devices.camera import CameraDecoder
from services.acquisition.devices.station_camera import StationCamera
from services.acquisition.drivers.sdk_link import BridgeDriver
from services.acquisition.mock_station import MockStation, build_mocks
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.replay import at_rate
from services.acquisition.settings import AcquisitionSettings, MockLinks
from tests.integration.recording_streams import human_streams, robot_streams
from tests.unit.acquisition.ledgers import accepted

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")


def streams(*names):
    return [s for s in pattern_streams(0.8) if s.descriptor.name in names]


def build(names, clock=None, **links):
    pairs = build_mocks(
        streams(*names),
        faults=FaultScript(),
        seed=1,
        clock=clock or VirtualClock(),
        links=MockLinks(**links),
    )
    known = {name: matrix for pair in pairs for name, matrix in pair.calibration.items()}
    return known, [pair.driver for pair in pairs]


def test_by_default_they_are_linked_as_ever():
    _, drivers = build(("tactile_left", "keypoints_left", "head", "camera_head"))
    kinds = [type(driver).__name__ for driver in drivers]
    assert kinds == ["TactileGlove", "FingerTracker", "Driver", "Driver"]


def test_each_link_has_the_driver_of_a_real_station():
    trackers = ("keypoints_left", "head")
    _, drivers = build(trackers, trackers="bridge")
    assert [type(driver) for driver in drivers] == [BridgeDriver, BridgeDriver]
    _, (camera,) = build(("camera_head",), images="h264")
    assert (type(camera.decoder), camera.descriptors[0].unit) == (CameraDecoder, "h264")
    _, (camera,) = build(("camera_head",), cameras="station", images="jpeg")
    assert (type(camera), camera.descriptors[0].unit) == (StationCamera, "jpeg")


def test_trackers_may_give_the_wrists_beside_a_robot():
    made = [*robot_streams(0.5), *human_streams(0.5)]
    made = list({stream.descriptor.name: stream for stream in made}.values())
    names = {}
    for wrists in ("robot", "trackers"):
        links = MockLinks(wrists=wrists)
        pairs = build_mocks(made, faults=FaultScript(), seed=1, clock=VirtualClock(), links=links)
        drivers = [pair.driver for pair in pairs]
        names[wrists] = [d.name for driver in drivers for d in driver.descriptors]
        assert ("pose_tracker_wrist_left" in [d.name for d in drivers]) == (wrists == "trackers")
    assert sorted(names["robot"]) == sorted(names["trackers"])
    assert len(set(names["robot"])) == len(names["robot"])


@pytest.mark.parametrize(("gloves", "num_values"), [("wuji_glove", 768), ("justfloat_glove", 401)])
def test_gloves_of_others_come_without_our_calibration(gloves, num_values):
    calibration, (glove,) = build(("tactile_left",), gloves=gloves)
    assert glove.descriptors[0].shape == (num_values,)
    assert calibration == {}


@pytest.mark.long
@pytest.mark.parametrize(
    "links",
    [
        MockLinks(gloves="wuji_glove", cameras="station", images="jpeg"),
        MockLinks(gloves="justfloat_glove", trackers="bridge", images="h264"),
    ],
)
def test_a_take_by_other_links_is_whole(links, tmp_path):
    played = streams("tactile_left", "keypoints_left", "wrist_left", "camera_head")
    with MockStation(
        played, FaultScript(), 1, VirtualClock(), spool_root=tmp_path, links=links
    ) as station:
        take = station.run_take(PROMPT, recording_id="take")
    spool = SpoolReader(take.spool_path)
    assert [p for p in take.check.problems if p.level == "ERROR"] == []
    for stream in played:
        name = stream.descriptor.name
        # A justfloat glove's first packet has no tail before it; H.264 comes in groups of 8.
        missing = {"tactile_left": 1, "camera_head": 7}.get(name, 0)
        rate = spool.streams[name].nominal_rate_hz / stream.descriptor.nominal_rate_hz
        assert len(spool.read(name)) >= rate * len(stream.t_ns) - missing


@pytest.mark.long
def test_a_bridge_without_samples_shows_that_it_lives(tmp_path):
    station = MockStation(
        streams("head"),
        FaultScript(),
        1,
        StationClock(),
        spool_root=tmp_path,
        links=MockLinks(trackers="bridge"),
    )
    with station:
        supervisor = station.station.supervisors[0]
        waiter = StationClock().waiter()
        # Longer than a silent bridge would be kept.
        waiter.wait_until(StationClock().now_ns() + 600_000_000)
        assert supervisor.reconnects == 0
        assert supervisor.driver.statistics.packets >= 5
        take = station.run_take(PROMPT, recording_id="take")
        num_stale = supervisor.events()["stale"]
        was_silent = supervisor.reconnects > 0
    num_recorded = len(SpoolReader(take.spool_path).read("head"))
    num_sent = len(accepted(take.ledger.of("pose_tracker_head")))
    # In real time a busy host may find samples too old, or a bridge too silent; it says so then.
    assert num_recorded + num_stale == num_sent or was_silent


@pytest.mark.long
def test_a_fault_that_a_device_cannot_have_is_said_so(tmp_path):
    faults = FaultScript(others=DeviceFaults(wrong_side_from_s=0.2))
    links = MockLinks(gloves="justfloat_glove")
    station = MockStation(
        streams("tactile_left"), faults, 1, VirtualClock(), spool_root=tmp_path, links=links
    )
    with station, pytest.raises(DeviceError, match="do not tell a hand"):
        station.run_take(PROMPT)


def test_a_stream_at_another_rate_is_interpolated():
    (stream,) = streams("tactile_left")
    fast = at_rate(stream, 120.0)
    assert len(fast.t_ns) == 2 * len(stream.t_ns)
    np.testing.assert_allclose(fast.values[::2], stream.values, rtol=1e-6)
    middle = (stream.values[0] + stream.values[1]) / 2
    np.testing.assert_allclose(fast.values[1], middle, rtol=1e-6)
    assert np.ptp(np.diff(fast.t_ns)) <= 2


async def test_the_setting_reaches_the_service(tmp_path):
    links = MockLinks(gloves="wuji_glove", trackers="bridge", cameras="station")
    settings = AcquisitionSettings(spool=tmp_path, mock=True, mock_links=links)
    app = create_app(settings)
    async with app.router.lifespan_context(app):
        pass
