"""Drawn hands and boxes against hand calculations."""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from dextouch.geometry import transform
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from services.world_model.rendering.inputs import grown
from services.world_model.rendering.rasters import (
    BoxHits,
    HandPoints,
    base_points_world,
    cast_boxes,
    colours_at_positions,
    object_transforms,
    positions_at_start,
    project_hands,
    splat_hands,
)
from tests.unit.world_model.rendering.scene_by_hand import K, stacked

SHAPE = (64, 64)


def _cast(T_camera_box, half_m) -> BoxHits:
    Ts = np.asarray(T_camera_box)[None, None]
    return cast_boxes(Ts, np.array(half_m)[None, None], np.array([[True]]), K[None], SHAPE)


def test_a_box_before_the_camera_covers_its_front_face():
    hits = _cast(transform(np.eye(3), np.array([0.0, 0.0, 0.6])), (0.05, 0.03, 0.1))
    # The front face is 0.5 m away: its half sides in pixels are 0.05 and 0.03 times f / 0.5 m.
    focal = K[0, 0]
    v, u = np.divmod(hits.place, 64)
    inside = np.abs(np.arange(64) + 0.5 - 32)
    assert set(u) == set(np.flatnonzero(inside < 0.05 * focal / 0.5))
    assert set(v) == set(np.flatnonzero(inside < 0.03 * focal / 0.5))
    np.testing.assert_allclose(hits.depth_m, 0.5)
    np.testing.assert_allclose(hits.local[:, 2], -1.0)
    middle = np.flatnonzero((u == 32) & (v == 32))[0]
    np.testing.assert_allclose(hits.thickness_m[middle], 0.2)
    np.testing.assert_allclose(hits.local[middle, 0], 0.5 / focal * 0.5 / 0.05)


def test_the_nearer_of_two_boxes_is_seen():
    Ts = np.stack([transform(np.eye(3), np.array([0.0, 0.0, z])) for z in (0.8, 0.5)])[None]
    half = np.full((1, 2, 3), 0.02)
    hits = cast_boxes(Ts, half, np.array([[True, True]]), K[None], SHAPE)
    assert (hits.slot == 1).all()
    swapped = cast_boxes(Ts[:, ::-1], half[:, ::-1], np.array([[True, True]]), K[None], SHAPE)
    assert (swapped.slot == 0).all()
    alone = cast_boxes(Ts, half, np.array([[True, False]]), K[None], SHAPE)
    assert len(alone.place) > 0
    assert (alone.slot == 0).all()


@pytest.mark.parametrize(
    ("place", "half_m"),
    [
        ([0, 0, -0.5], [0.02] * 3),
        ([0, 0, 0.0], [0.5] * 3),
        ([0, 0, 0.5], [0.0] * 3),
        ([0, 0, 0.5], [10.0, 0.0, 10.0]),
        ([1e6, 0, 1e6], [0.02] * 3),
    ],
)
def test_boxes_behind_the_camera_around_it_and_without_extent_stay_finite(place, half_m):
    hits = _cast(transform(np.eye(3), np.array(place, dtype=float)), half_m)
    for values in (hits.depth_m, hits.thickness_m, hits.local):
        assert np.isfinite(values).all()
    if place[2] <= 0:
        assert len(hits.place) == 0


def test_a_texture_moves_with_its_box():
    T_start = transform(np.eye(3), np.array([0.0, 0.0, 0.6]))
    T_now = transform(rotation_from_vector(np.array([0, 0, np.pi / 2])), np.array([0.1, 0.0, 0.6]))
    half = np.array([0.05, 0.03, 0.1])
    hits = _cast(T_now, half)
    at = positions_at_start(hits, T_start[None, None], half[None, None], K[None])
    v, u = np.divmod(hits.place, 64)
    # On the front face, 0.5 m away: 0.1 m are f / 5 pixels; a quarter turn of the image plane.
    dx, dy = u + 0.5 - 32 - K[0, 0] * 0.2, v + 0.5 - 32
    front = np.isclose(hits.local[:, 2], -1.0)
    assert front.sum() > 20
    np.testing.assert_allclose(at[front, 0], (32 + dy)[front], atol=1e-6)
    np.testing.assert_allclose(at[front, 1], (32 - dx)[front], atol=1e-6)


def test_bilinear_samples_are_means_of_neighbours():
    layers = np.arange(12.0).reshape(1, 1, 3, 4)
    at = np.array([[0.5, 0.5], [1.0, 0.5], [2.5, 2.0], [99.0, 99.0], [-5.0, -5.0]])
    sampled = colours_at_positions(layers, np.zeros(5, dtype=np.int64), at)[:, 0]
    np.testing.assert_allclose(sampled, [0.0, 0.5, 8.0, 11.0, 0.0])


def test_a_quaternion_of_no_length_is_no_turn():
    poses = np.array([[1.0, 2, 3, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 5.0]])
    T = object_transforms(poses)
    np.testing.assert_allclose(T[0, :3, :3], np.eye(3))
    np.testing.assert_allclose(T[1, :3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    assert np.allclose(quaternion_from_rotation(T[1, :3, :3])[1:3], 0)


def test_a_splat_shares_its_weight_among_four_pixels():
    pixels = np.full((1, 2, 1, 2), [10.75, 20.5])
    points = HandPoints(pixels, np.full((1, 2, 1), 0.5), np.array([[[True], [False]]]))
    raster = splat_hands(points, np.full((1, 2, 1, 3), [0.2, 0.4, 0.6]), SHAPE)
    covered = np.argwhere(raster.coverage[0, 0] > 0).tolist()
    # A quarter of a pixel right of the centre of column 10, at the centre of row 20.
    assert covered == [[20, 10], [20, 11]]
    weights = -np.log(1 - raster.coverage[0, 0, 20, 10:12])
    np.testing.assert_allclose(weights[0] / weights[1], 3.0, rtol=1e-5)
    np.testing.assert_allclose(raster.colour[0, :, 20, 10], [0.2, 0.4, 0.6], rtol=1e-6)
    np.testing.assert_allclose(raster.nearness[0, 0, 20, 11], 2.0, rtol=1e-6)
    assert raster.coverage[0, 1].max() == 0


def test_the_nearer_splat_gives_the_colour():
    pixels = np.full((1, 2, 1, 2), 32.5)
    points = HandPoints(pixels, np.array([[[0.5], [0.6]]]), np.ones((1, 2, 1), dtype=bool))
    colours = np.array([[[[1.0, 0, 0]], [[0, 1.0, 0]]]])
    raster = splat_hands(points, colours, SHAPE)
    np.testing.assert_allclose(raster.colour[0, :, 32, 32], [1, 0, 0], atol=1e-3)


def test_bones_end_where_the_pinhole_puts_their_joints(still):
    states = stacked(still)
    base = base_points_world(states)
    # The camera looks down from 0.6 m: a world point (x, y, z) is at f x / (0.6 - z).
    points = project_hands(base, K[None], states.Ts_world_camera, middle_only=True)
    wrist = still.Ts_world_wrist[1, :3, 3]
    distance = np.linalg.norm(
        points.pixels[0, 1] - (32 + K[0, 0] * np.array([wrist[0], -wrist[1]]) / (0.6 - wrist[2])),
        axis=-1,
    )
    assert distance.min() < 1e-9
    shown = splat_hands(
        project_hands(base, K[None], states.Ts_world_camera),
        np.ones((1, 2, 1, 3)) * np.ones((1, 2, points.depth_m.shape[2], 3)),
        SHAPE,
    )
    assert shown.coverage[0, 0, :, :32].sum() > 20
    assert shown.coverage[0, 1, :, 32:].sum() > 20


def test_hands_behind_the_camera_leave_nothing(still):
    states = stacked(still)
    up = states.Ts_world_camera @ transform(
        rotation_from_vector(np.array([np.pi, 0, 0])), np.zeros(3)
    )
    points = project_hands(base_points_world(states), K[None], up)
    raster = splat_hands(points, np.ones((1, 2, points.depth_m.shape[2], 3)), SHAPE)
    assert raster.coverage.max() == 0
    assert np.isfinite(raster.colour).all()


@pytest.mark.parametrize("reach_px", [1, 3, 4])
def test_masks_grow_by_the_largest_value_near(reach_px):
    draw = np.random.default_rng(0)
    mask = (draw.random((2, 1, 17, 23)) * (draw.random((2, 1, 17, 23)) > 0.9)).astype(np.float32)
    size = (1, 1, 2 * reach_px + 1, 2 * reach_px + 1)
    expected = maximum_filter(mask, size=size, mode="constant")
    np.testing.assert_array_equal(grown(mask, reach_px), expected)
