"""The robot's wrist goes where touching points meet; without touch one offset is all there is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import apply, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import NODE_INDEX
from dextouch.hands.robot_hand import RobotHand
from services.alignment.retargeting import HandRetargeter, wrist
from services.alignment.retargeting.wrist import (
    MatchedPoints,
    constant_offset_m,
    matched_points,
    robot_places_m,
    shifted_wrist,
    touch_offsets_m,
)
from services.twin.hands import HumanHand

NUM = 40
T_S = np.arange(NUM) / 15


def random_points(seed=0):
    rng = np.random.default_rng(seed)
    human, robot = rng.normal(scale=0.05, size=(2, NUM, 6, 3))
    return MatchedPoints(human, robot, np.ones((NUM, 6), dtype=bool))


def test_points_of_the_robots_own_hand_need_no_offset():
    hand = RobotHand("left")
    joints = np.full((3, 20), 0.2)
    chains = hand.chain_points_m(joints)
    keypoints = np.zeros((3, 25, 3))
    for finger, chain in enumerate(("thumb", "index", "middle", "ring", "little")):
        names = ("metacarpal", "proximal", "distal", "tip")
        if chain != "thumb":
            names = ("proximal", "intermediate", "distal", "tip")
        for point, name in enumerate(names):
            keypoints[:, NODE_INDEX[chain, name]] = chains[:, finger, point]
    points = matched_points(keypoints, joints, hand)
    assert points.seen.all()
    np.testing.assert_allclose(points.offset_m, 0.0, atol=1e-12)


def test_constant_offset_is_the_least_squares_one():
    human = HumanHand("right")
    keypoints = human.keypoints_m(np.linspace(0.0, 0.6, 5)[:, None] * np.ones(20))
    joints = HandRetargeter("right").retarget(keypoints).joints_rad
    points = matched_points(keypoints, joints, RobotHand("right"))
    offset = constant_offset_m(points)

    def squares(shift_m):
        return ((points.offset_m - shift_m) ** 2).sum()

    assert squares(offset) < 0.9 * squares(np.zeros(3))
    for axis in np.eye(3):
        assert squares(offset + 1e-3 * axis) > squares(offset)
        assert squares(offset - 1e-3 * axis) > squares(offset)


def test_what_touches_alone_decides(monkeypatch):
    points = random_points()
    forces = np.zeros((NUM, 6))
    forces[20, 1] = 5.0
    monkeypatch.setattr(wrist, "ANCHOR_N_S", 1e-9)
    offsets = touch_offsets_m(points, forces, T_S)
    np.testing.assert_allclose(offsets[20], points.offset_m[20, 1], atol=1e-8)
    # The approach half a second earlier has the offset of the grasp.
    np.testing.assert_allclose(offsets[13], points.offset_m[20, 1], atol=1e-7)


def test_without_touch_it_is_the_constant_offset():
    points = random_points()
    offsets = touch_offsets_m(points, np.zeros((NUM, 6)), T_S)
    np.testing.assert_allclose(offsets, np.tile(constant_offset_m(points), (NUM, 1)), atol=1e-15)
    np.testing.assert_allclose(constant_offset_m(points), points.offset_m.mean(axis=(0, 1)))


def test_sums_over_neighbours_are_those_of_the_formula(monkeypatch):
    monkeypatch.setattr(wrist, "REACH_S", 0.4)
    monkeypatch.setattr(wrist, "ANCHOR_N_S", 0.02)
    points = random_points(1)
    rng = np.random.default_rng(2)
    forces = rng.uniform(0, 3, (NUM, 6)) * (rng.random((NUM, 6)) > 0.5)
    t_s = np.cumsum(rng.uniform(0.02, 0.1, NUM))
    near = np.exp(-np.abs(t_s[:, None] - t_s) / 0.4)
    weight = near[:, :, None] * forces * np.gradient(t_s)[:, None]
    above = (weight[..., None] * points.offset_m).sum(axis=(1, 2))
    above += 0.02 * constant_offset_m(points)
    expected = above / (weight.sum(axis=(1, 2)) + 0.02)[:, None]
    np.testing.assert_allclose(touch_offsets_m(points, forces, t_s), expected, atol=1e-12)


def test_missing_nodes_count_nothing():
    human = HumanHand("right")
    keypoints = human.keypoints_m(np.full((NUM, 20), 0.3))
    joints = np.full((NUM, 20), 0.3)
    keypoints[:, NODE_INDEX["index", "tip"]] = np.nan
    keypoints[:5, NODE_INDEX["ring", "proximal"]] = np.nan
    points = matched_points(keypoints, joints, RobotHand("right"))
    assert not points.seen[:, 1].any()
    assert points.seen[:, 5].sum() == NUM - 5
    forces = np.ones((NUM, 6))
    without = forces.copy()
    without[:, 1] = 0
    offsets = touch_offsets_m(points, forces, T_S)
    assert np.isfinite(offsets).all()
    np.testing.assert_allclose(offsets, touch_offsets_m(points, without, T_S))
    nothing = MatchedPoints(points.human_m, points.robot_m, np.zeros_like(points.seen))
    with pytest.raises(InvalidInputError, match="no sample with a tracked fingertip"):
        constant_offset_m(nothing)


@given(st.integers(0, 2**31))
def test_shift_is_in_wrist_axes_and_moves_with_the_world(seed):
    rng = np.random.default_rng(seed)
    R = rotation_from_vector(rng.normal(size=(NUM, 3)))
    Ts = transform(R, rng.normal(size=(NUM, 3)))
    offsets = rng.normal(scale=0.02, size=(NUM, 3))
    shifted = shifted_wrist(Ts, offsets)
    np.testing.assert_allclose(shifted[:, :3, :3], R)
    np.testing.assert_allclose(shifted[:, :3, 3], apply(Ts, offsets[:, None])[:, 0], atol=1e-12)
    T_global = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    np.testing.assert_allclose(shifted_wrist(T_global @ Ts, offsets), T_global @ shifted, atol=1e-9)


def test_a_touched_place_lies_where_the_humans_lay(monkeypatch):
    points = random_points(3)
    forces = np.zeros((NUM, 6))
    forces[:, 2] = 4.0
    Ts = transform(rotation_from_vector(np.full((NUM, 3), 0.4)), np.ones((NUM, 3)))
    same = MatchedPoints(
        np.tile(points.human_m[:1], (NUM, 1, 1)),
        np.tile(points.robot_m[:1], (NUM, 1, 1)),
        points.seen,
    )
    monkeypatch.setattr(wrist, "ANCHOR_N_S", 1e-9)
    offsets = touch_offsets_m(same, forces, T_S)
    moved = shifted_wrist(Ts, offsets)
    np.testing.assert_allclose(
        apply(moved, same.robot_m)[:, 2], apply(Ts, same.human_m)[:, 2], atol=1e-8
    )


def test_what_does_not_fit_is_refused():
    points, forces = random_points(), np.zeros((NUM, 6))
    with pytest.raises(ShapeError, match="got forces"):
        touch_offsets_m(points, forces[:, :5], T_S)
    with pytest.raises(InvalidInputError, match="expected increasing times"):
        touch_offsets_m(points, forces, np.zeros(NUM))
    with pytest.raises(InvalidInputError, match="forces ≥ 0"):
        touch_offsets_m(points, forces - 1.0, T_S)
    with pytest.raises(NonFiniteError):
        touch_offsets_m(points, forces * np.nan, T_S)
    with pytest.raises(ShapeError, match="got keypoints"):
        matched_points(np.zeros((2, 21, 3)), np.zeros((2, 20)), RobotHand("left"))


def test_places_of_the_robot_are_tips_and_palm():
    hand = RobotHand("right")
    places = robot_places_m(np.zeros((1, 20)), hand)
    np.testing.assert_allclose(places[:, :5], hand.fingertips_m(np.zeros((1, 20))))
    knuckles = hand.chain_points_m(np.zeros((1, 20)))[0, 1:, 0]
    np.testing.assert_allclose(places[0, 5], 0.5 * knuckles.mean(axis=0))
