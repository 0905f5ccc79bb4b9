"""libsurvive's poses at a station, from a library with its C interface."""

import ctypes
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.errors import DeviceError, UnavailableError
from services.acquisition.sdk_bridges.lighthouse_trackers import LibsurviveTrackers

TRACKER, BASE, WAND = range(3)
SERIAL = "LHR-1A2B3C4D"


class Survive:
    """The library, and how a test moves its objects."""

    def __init__(self, path, library):
        self.path, self.library = str(path), library
        library.test_update.argtypes = (ctypes.c_int, *[ctypes.c_double] * 8)
        self.seconds = 100.0

    def move(self, index, R, t, *, step_s=0.004):
        self.seconds += step_s
        x, y, z, w = R.as_quat()
        self.library.test_update(index, self.seconds, *map(float, t), w, x, y, z)
        time.sleep(0.002)


@pytest.fixture
def survive(compiled):
    made = Survive(*compiled("libsurvive"))
    made.library.test_refuse(0)
    return made


def pose_of(sample):
    x, y, z, qw, qx, qy, qz = sample.values
    return Rotation.from_quat([qx, qy, qz, qw]), np.array([x, y, z])


def test_poses_arrive_as_they_are_with_their_own_clock(survive, serve, connect, read):
    rng = np.random.default_rng(0)
    R, t = Rotation.random(random_state=rng), rng.normal(size=3)
    bridge = serve(LibsurviveTrackers({SERIAL: "left"}, library=survive.path))
    driver = connect(kind="pose_tracker", stream="wrist_left", port=bridge.port)
    samples = read(driver, 5, after=lambda: survive.move(TRACKER, R, t))
    for sample in samples:
        got_R, got_t = pose_of(sample)
        # The world of libsurvive has z up, as ours; the wire has float32.
        np.testing.assert_allclose(got_t, t, atol=1e-6)
        assert (got_R.inv() * R).magnitude() < 1e-6
    steps_s = np.diff([sample.t_device_ns for sample in samples]) / 1e9
    np.testing.assert_allclose(steps_s / 0.004, np.rint(steps_s / 0.004), atol=1e-6)
    assert 100.0 < samples[0].t_device_ns / 1e9 <= survive.seconds


async def test_names_and_serial_numbers_at_the_route_of_a_station(survive, serve, live_poses):
    rng = np.random.default_rng(3)
    poses = {TRACKER: (Rotation.random(random_state=rng), rng.normal(size=3))}
    poses[WAND] = Rotation.random(random_state=rng), rng.normal(size=3)
    port = serve(LibsurviveTrackers({SERIAL: "left", "WM0": "right"}, library=survive.path)).port

    class Moving:
        def __iter__(self):
            for index, (R, t) in poses.items():
                survive.move(index, R, t)
                # Nobody asked for base stations.
                survive.move(BASE, R, t)
            return iter(("wrist_left", "wrist_right"))

    found = await live_poses(
        {"kind": "pose_tracker", "stream": "wrist_left", "port": port},
        {"kind": "pose_tracker", "stream": "wrist_right", "port": port},
        streams=Moving(),
    )
    for stream, index in (("wrist_left", TRACKER), ("wrist_right", WAND)):
        R, t = poses[index]
        np.testing.assert_allclose(found[stream][:3, :3], R.as_matrix(), atol=1e-6)
        np.testing.assert_allclose(found[stream][:3, 3], t, atol=1e-6)


def test_a_pose_before_the_first_solution_is_none(survive, serve, connect, read):
    port = serve(LibsurviveTrackers({SERIAL: "left"}, library=survive.path)).port
    driver = connect(kind="pose_tracker", stream="wrist_left", port=port)

    def move():
        survive.seconds += 0.004
        is_solved = driver.decoder.tracking["occluded"] >= 3
        survive.library.test_update(TRACKER, survive.seconds, 1, 2, 3, float(is_solved), 0, 0, 0)
        time.sleep(0.002)

    (sample, *_) = read(driver, after=move)
    np.testing.assert_allclose(sample.values, [1, 2, 3, 1, 0, 0, 0])
    assert driver.decoder.tracking["occluded"] >= 3


def test_a_repeated_stamp_is_old_and_an_earlier_run_is_a_restart(survive, serve, connect, read):
    bridge = serve(LibsurviveTrackers({SERIAL: "left"}, library=survive.path))
    driver = connect(kind="pose_tracker", stream="wrist_left", port=bridge.port)
    here = Rotation.identity(), np.ones(3)
    read(driver, 3, after=lambda: survive.move(TRACKER, *here))
    for _ in range(3):
        survive.move(TRACKER, *here, step_s=0.0)
        time.sleep(0.01)
    survive.seconds = 5.0
    samples = read(driver, 2, after=lambda: survive.move(TRACKER, *here))
    assert samples[-1].t_device_ns < 10**10
    summary = bridge.end()
    # A busy machine may fetch two updates at once.
    assert 1 <= summary.old[SERIAL] <= 3
    assert summary.restarts[SERIAL] == 1
    assert summary.delay_ms is None


def test_libsurvive_that_ends_is_started_again(survive, serve, connect, read):
    bridge = serve(LibsurviveTrackers({SERIAL: "left"}, library=survive.path))
    driver = connect(kind="pose_tracker", stream="wrist_left", port=bridge.port)
    survive.library.test_end()
    bridge.until_said("has ended")
    read(driver, after=lambda: survive.move(TRACKER, Rotation.identity(), np.ones(3)))


def test_arguments_are_passed_and_a_refusal_is_another_try(survive, monkeypatch):
    module = "services.acquisition.sdk_bridges.lighthouse_trackers"
    monkeypatch.setattr(f"{module}.LIST_S", 0.0)
    source = LibsurviveTrackers({}, library=survive.path, arguments=("--simulator",))
    assert source.present() == [
        "LHR-1A2B3C4D (T20)",
        "LHB-BASE (LH0)",
        "LHR-5E6F7A8B (WM0)",
    ]
    assert survive.library.test_arguments() == 2
    survive.library.test_refuse(1)
    with pytest.raises(DeviceError, match="does not start"):
        source.open()


def test_a_missing_library_is_said_with_the_remedy():
    source = LibsurviveTrackers({}, library="/nowhere/libsurvive.so")
    with pytest.raises(UnavailableError, match="--library"):
        source.open()
