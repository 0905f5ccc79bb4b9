"""Hands of MANUS gloves at a station, from a library with the C interface of the SDK."""

import ctypes
import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.errors import UnavailableError
from services.acquisition.clock import StationClock
from services.acquisition.sdk_bridges.manus_gloves import QUEUE_READINGS, ManusGloves

LEFT, RIGHT, OTHER_LEFT = range(3)
# Keypoint of each node of the library: wrist, pinky, thumb, index, ring, middle.
KEYPOINTS = [0, *range(20, 25), *range(1, 5), *range(5, 10), *range(15, 20), *range(10, 15)]


class Manus:
    """The library, and how a test moves its gloves."""

    def __init__(self, path, library):
        self.path, self.library = str(path), library
        for glove in range(3):
            library.test_stop(glove)

    def move(self, glove, keypoints_m, R, t, *, is_new=True):
        """Publish a hand whose wrist is turned by R and at t."""
        points = (R.apply(keypoints_m) + t)[KEYPOINTS].astype(np.float32)
        x, y, z, w = R.as_quat()
        wrist = np.array([w, x, y, z], dtype=np.float32)
        pointer = ctypes.POINTER(ctypes.c_float)
        self.library.test_move(
            glove, points.ctypes.data_as(pointer), wrist.ctypes.data_as(pointer), int(is_new)
        )

    def publish(self):
        self.library.test_publish()
        time.sleep(0.002)


@pytest.fixture
def manus(compiled):
    return Manus(*compiled("manus"))


@pytest.fixture
def hand(rng):
    """Keypoints of no hand in particular, relative to the wrist, in m."""
    points = rng.normal(scale=0.05, size=(25, 3))
    points[0] = 0.0
    return points


@pytest.fixture
def rng():
    return np.random.default_rng(12)


def fingers(port, side="left"):
    return {"kind": "finger_tracker", "side": side, "port": port}


# FingerJointType_Distal and FingerJointType_Intermediate: both name the thumb's third joint.
@pytest.mark.parametrize("thumb_joint", [4, 3])
def test_keypoints_are_relative_to_the_wrist_and_in_its_axes(
    manus, serve, connect, read, hand, rng, thumb_joint
):
    manus.library.test_thumb(thumb_joint)
    source = ManusGloves(library=manus.path)
    driver = connect(**fingers(serve(source).port))

    def move():
        # However the hand is turned and moved, the keypoints are the same.
        manus.move(LEFT, hand, Rotation.random(random_state=rng), rng.normal(size=3))
        manus.publish()

    before_ns = StationClock().now_ns()
    for sample in read(driver, 5, after=move):
        np.testing.assert_allclose(sample.values, hand, atol=1e-6)
        assert before_ns < sample.t_device_ns <= sample.t_host_ns
    # AxisView_XFromViewer, AxisPolarity_PositiveZ, Side_Right, in the world, HandMotion_None.
    assert [manus.library.test_axes(which) for which in range(5)] == [3, 6, 2, 1, 0]


async def test_both_hands_at_the_route_of_a_station(manus, serve, live_poses, hand):
    port = serve(ManusGloves(library=manus.path)).port
    turn = Rotation.from_euler("xyz", [0.3, -1.0, 2.0])

    class Moving:
        def __iter__(self):
            manus.move(LEFT, hand, turn, np.ones(3))
            manus.move(RIGHT, 2 * hand, turn, np.ones(3))
            manus.publish()
            return iter(("keypoints_left", "keypoints_right"))

    found = await live_poses(fingers(port), fingers(port, "right"), streams=Moving())
    np.testing.assert_allclose(found["keypoints_left"], hand, atol=1e-6)
    np.testing.assert_allclose(found["keypoints_right"], 2 * hand, atol=1e-6)


def test_repeated_data_is_not_sent(manus, serve, connect, read, hand, until):
    source = ManusGloves(("left",), library=manus.path)
    bridge = serve(source)
    driver = connect(**fingers(bridge.port))
    here = Rotation.identity(), np.zeros(3)

    def move():
        manus.move(LEFT, hand, *here)
        manus.publish()

    read(driver, 2, after=move)
    for _ in range(5):
        manus.move(LEFT, hand, *here, is_new=False)
        manus.publish()
    manus.move(RIGHT, hand, *here)
    manus.publish()
    until(lambda: source.not_sent["another glove"], driver.read)
    summary = bridge.end()
    assert summary.not_sent["unchanged"] >= 5
    assert summary.not_sent["another glove"] == 1
    assert set(summary.sent) == {"manus-left"}


def test_a_node_that_is_not_finite_is_not_seen(manus, serve, connect, read, hand):
    driver = connect(**fingers(serve(ManusGloves(library=manus.path)).port))
    damaged = hand.copy()
    damaged[7] = np.nan

    def move():
        manus.move(LEFT, damaged, Rotation.identity(), np.zeros(3))
        manus.publish()

    (sample, *_) = read(driver, after=move)
    assert np.flatnonzero(np.isnan(sample.values).any(axis=1)).tolist() == [7]


def test_a_wrist_without_a_rotation_is_no_sample(manus, serve, connect, until):
    source = ManusGloves(library=manus.path)
    connect(**fingers(serve(source).port))
    nothing = (ctypes.c_float * 75)()

    def move():
        manus.library.test_move(LEFT, nothing, nothing, 1)
        manus.publish()

    until(lambda: source.not_sent["no wrist"] >= 3, move)


@pytest.mark.parametrize("is_repeated", [False, True])
def test_a_second_glove_of_a_hand_takes_over_from_a_silent_one(
    manus, serve, connect, read, hand, monkeypatch, until, is_repeated
):
    source = ManusGloves(library=manus.path)
    driver = connect(**fingers(serve(source).port))
    here = Rotation.identity(), np.zeros(3)

    def move(glove, scale):
        manus.move(glove, scale * hand, *here)
        manus.publish()

    read(driver, 2, after=lambda: move(LEFT, 1.0))
    move(OTHER_LEFT, 2.0)
    until(lambda: source.not_sent["another glove"], driver.read)
    # As if a second had passed.
    monkeypatch.setattr("services.acquisition.sdk_bridges.manus_gloves.REPLACED_NS", 10_000_000)
    if not is_repeated:
        manus.library.test_stop(LEFT)
    samples = read(driver, 3, after=lambda: move(OTHER_LEFT, 2.0))
    np.testing.assert_allclose(samples[-1].values, 2 * hand, atol=1e-6)


def test_the_callback_waits_for_nobody(manus, hand):
    source = ManusGloves(library=manus.path)
    source.open()
    manus.move(LEFT, hand, Rotation.identity(), np.zeros(3))
    # Nobody reads: the oldest are lost, and counted.
    calls = threading.Thread(
        target=lambda: [manus.library.test_publish() for _ in range(QUEUE_READINGS + 36)]
    )
    calls.start()
    calls.join(20)
    assert not calls.is_alive()
    assert source.not_sent["queue full"] == 36
    source.close()


def test_a_core_that_is_gone_is_connected_again(manus, serve, connect, read, hand):
    bridge = serve(ManusGloves(library=manus.path))
    driver = connect(**fingers(bridge.port))
    manus.library.test_disconnect()
    bridge.until_said("lost its core")

    def move():
        manus.move(LEFT, hand, Rotation.identity(), np.zeros(3))
        manus.publish()

    read(driver, 2, after=move)


def test_a_missing_library_is_said_with_the_remedy():
    with pytest.raises(UnavailableError, match="download the MANUS Core SDK"):
        ManusGloves(library="/nowhere/libManusSDK_Integrated.so").open()
