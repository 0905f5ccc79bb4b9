"""Hands of an OpenXR runtime at a station, from a library with the C interface of the loader."""

import ctypes
import json
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.errors import DeviceError, UnavailableError
from dextouch.hands import NODES
from services.acquisition.clock import StationClock
from services.acquisition.sdk_bridges.openxr_hands import LIBRARY, OpenXrHands

LEFT, RIGHT = 0, 1
# XR_SPACE_LOCATION_*_BIT of openxr.h.
ORIENTATION_VALID, POSITION_VALID, ORIENTATION_TRACKED, POSITION_TRACKED = 1, 2, 4, 8
ALL = 15
PALM, WRIST, THUMB_TIP, INDEX_TIP, LITTLE_TIP = 0, 1, 5, 10, 25


class Runtime:
    """The library, and how a test moves its hands."""

    def __init__(self, path, library):
        self.path, self.library = str(path), library
        library.test_request.restype = ctypes.c_int64
        library.test_runtime(1)
        self.count = 0

    def show(self, hand, joints_m, R, *, flags=ALL, is_active=True):
        """Joints [26, 3] (m) in OpenXR's space, of a hand whose wrist is turned by R."""
        # Noise, since no two measurements are alike; far below what is compared.
        self.count += 1
        poses = np.zeros((26, 7), dtype=np.float32)
        poses[:, :3] = joints_m
        poses[PALM, 0] += 1e-5 * self.count
        poses[:, 3:] = R.as_quat()
        each = np.broadcast_to(np.uint64(flags), 26).copy()
        self.library.test_hand(
            hand,
            int(is_active),
            each.ctypes.data_as(ctypes.POINTER(ctypes.c_uint64)),
            poses.ctypes.data_as(ctypes.POINTER(ctypes.c_float)),
        )
        time.sleep(0.002)


@pytest.fixture
def runtime(compiled):
    return Runtime(*compiled("openxr"))


@pytest.fixture
def rng():
    return np.random.default_rng(2)


def fingers(port, side="left"):
    return {"kind": "finger_tracker", "side": side, "port": port}


def flat_hand(side):
    """Joints of a flat hand in the axes of its wrist joint, as the specification has them.

    The fingers point to −z and the back of the hand to +y. So +x, which is right of a hand with the
    palm down, is the side of the thumb of a left hand, and of the little finger of a right one.
    """
    thumb = 1.0 if side == "left" else -1.0
    joints = np.zeros((26, 3))
    joints[THUMB_TIP] = 0.08 * thumb, -0.02, -0.06
    joints[INDEX_TIP] = 0.03 * thumb, 0.0, -0.18
    joints[LITTLE_TIP] = -0.04 * thumb, 0.0, -0.15
    return joints


@pytest.mark.parametrize("side", ["left", "right"])
def test_hands_are_in_our_wrist_axes(runtime, serve, connect, read, side, rng):
    driver = connect(**fingers(serve(OpenXrHands(library=runtime.path)).port, side))
    joints = flat_hand(side)

    def show():
        R = Rotation.random(random_state=rng)
        runtime.show(LEFT if side == "left" else RIGHT, R.apply(joints) + rng.normal(size=3), R)

    points = read(driver, 4, after=show)[-1].values
    tips = {name: points[NODES.index((name, "tip"))] for name in ("thumb", "index", "little")}
    # docs/hand_frames.md: −z to the fingers, +x to the thumb's side of either hand, and out of the
    # palm at +y on the right hand, at −y on the left. The thumb's tip is 2 cm before the palm.
    out_of_palm = 0.02 if side == "right" else -0.02
    np.testing.assert_allclose(tips["thumb"], [0.08, out_of_palm, -0.06], atol=1e-6)
    np.testing.assert_allclose(tips["index"], [0.03, 0.0, -0.18], atol=1e-6)
    np.testing.assert_allclose(tips["little"], [-0.04, 0.0, -0.15], atol=1e-6)


async def test_all_joints_at_the_route_of_a_station(runtime, serve, live_poses, rng):
    port = serve(OpenXrHands(library=runtime.path)).port
    joints = rng.normal(scale=0.05, size=(26, 3))
    R, t = Rotation.random(random_state=rng), rng.normal(size=3)

    class Showing:
        def __iter__(self):
            runtime.show(LEFT, R.apply(joints) + t, R)
            return iter(("keypoints_left",))

    found = (await live_poses(fingers(port), streams=Showing()))["keypoints_left"]
    # A left hand's axes are those of its wrist joint; the palm is no keypoint, and the other
    # joints are in the order of XrHandJointEXT.
    np.testing.assert_allclose(found, joints[1:] - joints[WRIST], atol=2e-6)


def test_a_joint_that_is_not_tracked_is_not_seen(runtime, serve, connect, read):
    driver = connect(**fingers(serve(OpenXrHands(library=runtime.path)).port))
    flags = np.full(26, ALL, dtype=np.uint64)
    # Inferred, as valid poses without the tracked bits are; and not even valid.
    flags[THUMB_TIP] = ORIENTATION_VALID | POSITION_VALID
    flags[INDEX_TIP] = ORIENTATION_TRACKED | POSITION_TRACKED
    hand = flat_hand("left"), Rotation.identity()
    sample = read(driver, 5, after=lambda: runtime.show(LEFT, *hand, flags=flags))[-1]
    unseen = {NODES[node] for node in np.flatnonzero(np.isnan(sample.values).any(axis=1))}
    assert unseen == {("thumb", "tip"), ("index", "tip")}


@pytest.mark.parametrize("case", ["not active", "wrist inferred"])
def test_a_hand_that_is_not_there_is_all_unseen(runtime, serve, connect, read, case):
    driver = connect(**fingers(serve(OpenXrHands(library=runtime.path)).port))
    flags = np.full(26, ALL, dtype=np.uint64)
    if case == "wrist inferred":
        flags[WRIST] = ALL - ORIENTATION_TRACKED

    def show():
        runtime.show(
            LEFT,
            flat_hand("left"),
            Rotation.identity(),
            flags=flags,
            is_active=case != "not active",
        )

    show()
    for sample in read(driver, 5, after=show)[1:]:
        assert np.isnan(sample.values).all()


def test_stamps_are_the_time_of_the_request(runtime, serve, connect, read):
    driver = connect(**fingers(serve(OpenXrHands(library=runtime.path)).port))
    before_ns = time.monotonic_ns()
    offset_ns = StationClock().now_ns() - before_ns
    samples = read(
        driver,
        5,
        after=lambda: runtime.show(LEFT, flat_hand("left"), Rotation.identity()),
    )
    # The runtime was asked in CLOCK_MONOTONIC for a moment of this test.
    assert before_ns - 10**9 < runtime.library.test_request() <= time.monotonic_ns()
    on_monotonic_ns = samples[-1].t_device_ns - offset_ns
    assert before_ns < on_monotonic_ns + 5_000_000
    assert on_monotonic_ns < time.monotonic_ns() + 5_000_000


def test_unchanged_joints_are_not_sent(runtime, serve, connect, until):
    source = OpenXrHands(("left",), library=runtime.path)
    bridge = serve(source)
    driver = connect(**fingers(bridge.port))
    runtime.show(LEFT, flat_hand("left"), Rotation.identity())
    until(lambda: source.not_sent["unchanged"] >= 5, driver.read)
    assert bridge.end().not_sent["unchanged"] >= 5


@pytest.mark.parametrize("end", ["exiting", "lost"])
def test_a_runtime_that_ends_is_waited_for(runtime, serve, connect, read, end):
    bridge = serve(OpenXrHands(library=runtime.path))
    driver = connect(**fingers(bridge.port))
    if end == "exiting":
        runtime.library.test_state(8)
        bridge.until_said("ends the session (state 8)")
    else:
        runtime.library.test_runtime(0)
        bridge.until_said("xrCreateInstance gave XrResult -17")
        runtime.library.test_runtime(1)
    read(driver, 3, after=lambda: runtime.show(LEFT, flat_hand("left"), Rotation.identity()))


def test_the_real_loader_takes_our_calls(runtime, serve, connect, read, tmp_path, monkeypatch):
    try:
        ctypes.CDLL(LIBRARY)
    except OSError:
        pytest.skip(f"the OpenXR loader is not installed ({LIBRARY})")
    # It loads the library as its runtime, and checks structures and handles on the way.
    manifest = {"file_format_version": "1.0.0", "runtime": {"library_path": runtime.path}}
    (tmp_path / "runtime.json").write_text(json.dumps(manifest))
    monkeypatch.setenv("XR_RUNTIME_JSON", str(tmp_path / "runtime.json"))
    driver = connect(**fingers(serve(OpenXrHands()).port))
    joints = flat_hand("left")
    sample = read(driver, 5, after=lambda: runtime.show(LEFT, joints, Rotation.identity()))[-1]
    np.testing.assert_allclose(sample.values, joints[1:], atol=1e-6)


def test_no_runtime_is_another_try(runtime):
    runtime.library.test_runtime(0)
    with pytest.raises(DeviceError, match="XR_MND_headless"):
        OpenXrHands(library=runtime.path).open()


def test_a_missing_loader_is_said_with_the_remedy():
    with pytest.raises(UnavailableError, match="libopenxr-loader1"):
        OpenXrHands(library="/nowhere/libopenxr_loader.so.1").open()
