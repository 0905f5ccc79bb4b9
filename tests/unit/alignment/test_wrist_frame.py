"""The wrist frame of a tracked hand in axes of its tracker, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.geometry import apply, invert
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from dextouch.hands import KNUCKLE_NODES, METACARPAL_NODES, NODE_INDEX, PALM_NODES, WRIST_NODE
from services.alignment.retargeting.wrist import calibrate_wrist, wrist_frame
from tests.unit.alignment.tracked_hands import (
    any_rotation,
    flat_hand,
    moving_hand,
    of_another_person,
)

SIDES = ("left", "right")


def refusal(call, *arguments):
    with pytest.raises(InvalidInputError) as caught:
        call(*arguments)
    return caught.value


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("make", [moving_hand, flat_hand])
def test_the_frame_of_a_mean_hand_is_exact(side, make):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        R_tracker_wrist, offset = any_rotation(rng), rng.normal(size=3)
        keypoints = make(side, rng)
        frame = wrist_frame(keypoints @ R_tracker_wrist.T + offset, side)
        np.testing.assert_allclose(frame.T_tracker_wrist[:3, :3], R_tracker_wrist, atol=1e-9)
        np.testing.assert_allclose(frame.T_tracker_wrist[:3, 3], offset, atol=1e-12)
        # Keypoints come back to wrist axes.
        T_wrist_tracker = invert(frame.T_tracker_wrist)
        there = apply(T_wrist_tracker, keypoints @ R_tracker_wrist.T + offset)
        np.testing.assert_allclose(there, keypoints, atol=1e-9)
        assert frame.size == pytest.approx(1.0)
        assert frame.sigma_rad < 1e-9
        assert frame.turn_rad < 1e-7


@pytest.mark.long
@settings(max_examples=30)
@given(st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3), st.integers(0, 20))
def test_the_frame_turns_with_the_hand(vector, seed):
    rng = np.random.default_rng(seed)
    keypoints = of_another_person(flat_hand("right", rng), rng)
    keypoints += rng.normal(scale=1e-3, size=keypoints.shape)
    R = rotation_from_vector(np.array(vector))
    before, after = wrist_frame(keypoints, "right"), wrist_frame(keypoints @ R.T, "right")
    turned = R @ before.T_tracker_wrist[:3, :3]
    R_off = turned.T @ after.T_tracker_wrist[:3, :3]
    assert rotation_angle(R_off) < 1e-6
    assert np.linalg.det(after.T_tracker_wrist[:3, :3]) == pytest.approx(1.0)
    assert after.size == pytest.approx(before.size)


def test_a_wrist_that_is_not_seen_is_where_the_palm_says():
    rng = np.random.default_rng(4)
    keypoints = flat_hand("left", rng)
    keypoints[:, WRIST_NODE] = np.nan
    offset = np.array([0.1, 0.2, 0.3])
    frame = wrist_frame(keypoints + offset, "left")
    np.testing.assert_allclose(frame.T_tracker_wrist[:3, 3], offset, atol=1e-9)


def test_nodes_that_are_seldom_seen_do_not_count():
    rng = np.random.default_rng(5)
    keypoints = flat_hand("right", rng, 200)
    node = NODE_INDEX["index", "proximal"]
    wrong = keypoints.copy()
    wrong[:, node] = np.nan
    wrong[:5, node] = keypoints[:5, node] + 0.02
    frame = wrist_frame(wrong, "right")
    assert rotation_angle(frame.T_tracker_wrist[:3, :3]) < 1e-7


@pytest.mark.parametrize("call", [wrist_frame, calibrate_wrist])
def test_what_shows_no_wrist_frame_is_refused_with_its_reason(call):
    rng = np.random.default_rng(6)
    flat = flat_hand("right", rng)

    few = flat.copy()
    few[:, PALM_NODES[:6]] = np.nan
    assert refusal(call, few, "right").details["fault"] == "unseen"

    # Each node in other samples, never four of them often enough.
    scattered = np.full((60, 25, 3), np.nan)
    scattered[:4] = flat[:4]
    scattered[4:, PALM_NODES[:3]] = flat[4:, PALM_NODES[:3]]
    scattered[:, 7:] = flat[:, 7:]
    scattered[4:, PALM_NODES[3:]] = np.nan
    assert refusal(wrist_frame, scattered[4:], "right").details["fault"] == "unseen"

    line = flat.copy()
    line[:] = np.arange(25)[:, None] * [0.0, 0.0, -0.01]
    error = refusal(call, line, "right")
    assert error.details["fault"] == "collinear"
    assert "along a line" in error.message

    # Four knuckles and nothing else of the palm hardly show the turn about their row.
    row = flat.copy()
    row[:, [WRIST_NODE, *METACARPAL_NODES]] = np.nan
    row += rng.normal(scale=4e-3, size=(1, 25, 3))
    assert refusal(call, row, "right").details["fault"] == "uncertain"

    mirrored = moving_hand("right", rng) if call is wrist_frame else flat
    error = refusal(call, mirrored * [-1, 1, 1], "right")
    assert error.details == {"fault": "side", "found": "left"}

    assert refusal(call, flat * 1e3, "right").details["found"] == "millimetres"
    with pytest.raises(ShapeError):
        call(flat[:, :21], "right")


def test_axes_that_do_not_turn_with_the_wrist_are_refused():
    rng = np.random.default_rng(7)
    keypoints = moving_hand("left", rng, 100)
    turns = rotation_from_vector(np.linspace(0, 1.0, 100)[:, None] * [0.0, 1.0, 0.0])
    in_world = np.einsum("tij,tnj->tni", turns, keypoints)
    error = refusal(wrist_frame, in_world, "left")
    assert error.details["fault"] == "moving_axes"
    assert "relative to the wrist" in error.message


def test_only_samples_of_the_flat_hand_calibrate():
    rng = np.random.default_rng(8)
    flat, moving = flat_hand("right", rng, 40), moving_hand("right", rng, 100)
    # While it moves, the palm is bent.
    moving[:, KNUCKLE_NODES[2:], 1] += 0.012
    R = any_rotation(rng)
    take = np.concatenate([moving, flat]) @ R.T
    frame = calibrate_wrist(take, "right")
    assert frame.num_samples < 80
    assert rotation_angle(R.T @ frame.T_tracker_wrist[:3, :3]) < np.deg2rad(0.1)
    bent = wrist_frame(take, "right")
    assert rotation_angle(R.T @ bent.T_tracker_wrist[:3, :3]) > np.deg2rad(2)


@pytest.mark.parametrize("finger", ["index", "ring"])
def test_a_take_without_the_flat_hand_is_refused_and_the_finger_named(finger):
    rng = np.random.default_rng(9)
    flat = flat_hand("right", rng)
    flat[:, NODE_INDEX[finger, "tip"]] = flat[:, NODE_INDEX[finger, "proximal"]] + [0, 0.03, 0]
    error = refusal(calibrate_wrist, flat, "right")
    assert error.details == {"fault": "not_flat", "found": finger}
    assert refusal(calibrate_wrist, flat_hand("right", rng, 20), "right").message.count(" 20 ") == 1


def test_infinite_nodes_are_nodes_that_are_not_seen():
    rng = np.random.default_rng(10)
    flat = flat_hand("left", rng)
    hidden, infinite = flat.copy(), flat.copy()
    hidden[::3, 6:9] = np.nan
    infinite[::3, 6:9, 2] = np.inf
    for call in (wrist_frame, calibrate_wrist):
        a, b = call(hidden, "left"), call(infinite, "left")
        np.testing.assert_array_equal(a.T_tracker_wrist, b.T_tracker_wrist)
