"""Keypoints of a recording come to wrist axes by its calibration, or are refused."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from dextouch.hands import NODE_INDEX
from dextouch.schemas import matrix_rows
from services.acquisition.mocks.pattern import pattern_streams
from services.alignment.retargeting import HandRetargeter
from services.alignment.retargeting.wrist import (
    calibrate_wrist,
    calibration_record,
    hand_axes_check,
    wrist_frame,
)
from tests.unit.alignment.tracked_hands import (
    any_rotation,
    flat_hand,
    moving_hand,
    of_another_person,
)

SIDES = ("left", "right")


def off_rad(keypoints, side):
    """How far the palm is turned from the wrist's axes."""
    return rotation_angle(wrist_frame(keypoints, side).T_tracker_wrist[:3, :3])


@pytest.mark.parametrize("side", SIDES)
def test_keypoints_in_wrist_axes_stay_as_they_are(side):
    for seed in range(8):
        rng = np.random.default_rng(seed)
        keypoints = of_another_person(moving_hand(side, rng), rng)
        checked = hand_axes_check(keypoints, side, {})
        np.testing.assert_array_equal(checked, keypoints)
        assert off_rad(checked, side) < np.deg2rad(15)


@pytest.mark.parametrize("side", SIDES)
def test_keypoints_in_other_axes_need_a_calibration(side):
    rng = np.random.default_rng(1)
    R, offset = any_rotation(rng), rng.normal(size=3)
    keypoints = moving_hand(side, rng)
    keypoints[5, 3] = np.nan
    keypoints[6, 4, 0] = np.inf
    tracked = keypoints @ R.T + offset if side == "left" else keypoints @ R.T
    with pytest.raises(InvalidInputError, match=f"calibrate wrist --side {side}") as e:
        hand_axes_check(tracked[:5], side, {})
    assert e.value.details["fault"] == "axes"

    flat = flat_hand(side, rng) @ R.T
    flat += rng.normal(scale=1e-3, size=flat.shape) + (offset if side == "left" else 0.0)
    record = calibration_record(calibrate_wrist(flat, side), side)
    assert sorted(record) == [
        f"T_keypoints_{side}_wrist_{side}",
        f"T_keypoints_{side}_wrist_{side}_sigma_rad",
    ]
    checked = hand_axes_check(tracked, side, record)
    assert np.isnan(checked[5, 3]).all()
    assert np.isnan(checked[6, 4]).all()
    seen = np.isfinite(checked).all(axis=-1)
    assert np.count_nonzero(~seen) == 2
    assert np.abs(checked - keypoints)[seen].max() < 2e-3
    # The other hand's calibration is not taken for this one's.
    other = "right" if side == "left" else "left"
    with pytest.raises(InvalidInputError, match="record the flat hand"):
        hand_axes_check(
            tracked[:5], side, {name.replace(side, other): m for name, m in record.items()}
        )


@pytest.mark.long
def test_joints_of_a_turned_hand_are_those_of_the_hand():
    rng = np.random.default_rng(2)
    keypoints, R = moving_hand("right", rng, 20), any_rotation(rng)
    record = calibration_record(calibrate_wrist(flat_hand("right", rng) @ R.T, "right"), "right")
    turned = hand_axes_check(keypoints @ R.T, "right", record)
    direct = HandRetargeter("right").retarget(keypoints)
    np.testing.assert_allclose(
        HandRetargeter("right").retarget(turned).joints_rad, direct.joints_rad, atol=1e-4
    )


def test_the_made_up_hands_of_mock_stations_are_hands_in_wrist_axes():
    made_up = [s for s in pattern_streams() if s.descriptor.kind == "keypoints"]
    assert len(made_up) == len(SIDES)
    for stream in made_up:
        side = stream.descriptor.name.split("_")[1]
        assert off_rad(hand_axes_check(stream.values, side, {}), side) < 1e-6
        assert np.ptp(stream.values[:, NODE_INDEX["index", "tip"]], axis=0).max() > 0.05


def test_a_calibration_that_does_not_fit_is_refused():
    rng = np.random.default_rng(3)
    keypoints = moving_hand("right", rng)
    R = rotation_from_vector(np.array([0.0, 0.0, np.deg2rad(40)]))
    record = {"T_keypoints_right_wrist_right": matrix_rows(transform(R, np.zeros(3)))}
    with pytest.raises(InvalidInputError, match=r"turned by 40 degrees.*does not fit") as refusal:
        hand_axes_check(keypoints, "right", record)
    assert refusal.value.details["off_deg"] == pytest.approx(40, abs=0.5)


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        1.01 * np.eye(4),
        np.eye(4) + np.diag([0.0, 0.0, 0.0], k=-1) + 1e-3 * np.eye(4, k=-3),
    ],
)
def test_a_calibration_that_is_no_transform_is_refused(matrix):
    keypoints = moving_hand("right", np.random.default_rng(4))
    record = {"T_keypoints_right_wrist_right": matrix_rows(matrix)}
    with pytest.raises(InvalidInputError, match="calibration 'T_keypoints_right_wrist_right'"):
        hand_axes_check(keypoints, "right", record)


@pytest.mark.parametrize(
    ("break_it", "fault"),
    [
        (lambda k: k * 1e3, "unit"),
        (lambda k: k * [1, -1, 1], "side"),
        (lambda k: k[:, ::-1], "node_order"),
        (lambda k: k * np.nan, "unseen"),
    ],
)
def test_broken_recordings_are_refused_by_name(break_it, fault):
    keypoints = moving_hand("left", np.random.default_rng(5))
    with pytest.raises(InvalidInputError, match="keypoints_left") as refusal:
        hand_axes_check(break_it(keypoints), "left", {})
    assert refusal.value.details["fault"] == fault


def corrupted(keypoints, rng):
    """One fault of those that trackers and their users make, in some of the nodes."""
    hit = rng.random(keypoints.shape[:2]) < rng.choice([0.02, 0.3, 0.9])
    broken = keypoints.copy()
    kind = rng.integers(6)
    if kind == 0:
        broken[hit] = rng.choice([np.nan, np.inf, 0.0, 1e300, 5e-324])
    elif kind == 1:
        broken = broken * rng.choice([1e3, 1e-3, 0.0, 1e-310])
    elif kind == 2:
        broken[hit] += rng.normal(scale=0.05, size=3)
    elif kind == 3:
        broken = broken[:, rng.permutation(25)]
    elif kind == 4:
        broken = np.repeat(broken[:1], len(broken), axis=0)
    else:
        broken[:, rng.integers(0, 25, 3)] = broken[:, rng.integers(0, 25, 3)]
    return broken


@pytest.mark.long
def test_whatever_comes_is_an_answer_without_nan_or_a_refusal():
    num_answers, faults = 0, []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        keypoints = corrupted(moving_hand("left", rng, 40), rng)
        for call in (_checked_frame, _calibrated_frame):
            try:
                frame = call(keypoints)
            except InvalidInputError as refusal:
                faults.append(refusal.details["fault"])
                continue
            num_answers += 1
            assert np.isfinite(frame.T_tracker_wrist).all()
            assert np.isfinite(frame.sigma_rad)
    assert num_answers > 20
    assert len(faults) > 100
    assert set(faults) <= {
        *("unit", "node_order", "no_hand", "side", "unseen"),
        *("collinear", "uncertain", "moving_axes", "not_flat", "axes"),
    }


def _checked_frame(keypoints):
    return wrist_frame(hand_axes_check(keypoints, "left", {}), "left")


def _calibrated_frame(keypoints):
    return calibrate_wrist(keypoints, "left")
