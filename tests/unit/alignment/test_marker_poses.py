"""Poses from markers, against images that OpenCV's own camera model renders."""

import cv2
import numpy as np
import pytest

from dextouch.geometry import invert, pose_from_transform, transform, transform_from_pose
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from dextouch.schemas import ObjectMarker, SceneObject
from services.alignment.markers import (
    MarkerTracker,
    _Candidate,
    _decided,
)

DICTIONARY = "DICT_4X4_50"
SIZE_M = 0.05
HEIGHT_PX, WIDTH_PX = 480, 640
K = np.array([[560.0, 0.0, 320.0], [0.0, 555.0, 240.0], [0.0, 0.0, 1.0]])
NO_DISTORTION = np.zeros(5)
DISTORTION = np.array([-0.28, 0.09, 0.001, -0.0008, 0.0])
BOX = (0.0, 0.0, 0.0, 0.04, 0.04, 0.04)
FACING = rotation_from_vector(np.array([np.pi, 0.0, 0.0]))


def cube(*, size_m=SIZE_M):
    """A cube of 8 cm with markers on its top and on the side that looks along −y."""
    top = transform(np.eye(3), np.array([0.0, 0.0, 0.04]))
    front = transform(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([0.0, -0.04, 0.0]))
    markers = [
        ObjectMarker(id=number, size_m=size_m, pose=tuple(pose_from_transform(T).tolist()))
        for number, T in ((3, top), (7, front))
    ]
    return SceneObject(name="cube", box_m=BOX, markers=tuple(markers))


def draw(image, marker_id, T_camera_marker, distortion):
    """Draw a marker: for every pixel, the point of the print that OpenCV's lens shows there."""
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    texture = cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(kind, marker_id, 240), 40, 40, 40, 40, 0, value=255
    )
    fine = 3
    v, u = np.mgrid[0 : HEIGHT_PX * fine, 0 : WIDTH_PX * fine]
    # OpenCV's pixel centres are whole numbers; K counts from the corner of the first pixel.
    pixels = np.stack([(u + 0.5) / fine - 0.5, (v + 0.5) / fine - 0.5], axis=-1)
    opencv_K = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    flat = pixels.reshape(-1, 1, 2).astype(np.float64)
    rays = cv2.undistortPoints(flat, opencv_K, distortion).reshape((*v.shape, 2))
    rays = np.concatenate([rays, np.ones((*v.shape, 1))], axis=-1)
    normal, centre = T_camera_marker[:3, 2], T_camera_marker[:3, 3]
    depth = (normal @ centre) / (rays @ normal)
    points = (rays * depth[..., None] - centre) @ T_camera_marker[:3, :3]
    scale = 240 / SIZE_M
    column = points[..., 0] * scale + 160
    row = 160 - points[..., 1] * scale
    inside = (column >= 0) & (column < 320) & (row >= 0) & (row < 320)
    shades = texture[row.clip(0, 319).astype(int), column.clip(0, 319).astype(int)]
    picture = np.where(inside, shades, np.nan)
    blocks = picture.reshape(HEIGHT_PX, fine, WIDTH_PX, fine)
    share = np.isfinite(blocks).mean(axis=(1, 3))
    painted = np.nansum(blocks, axis=(1, 3)) / fine**2
    image[:] = (image * (1 - share) + painted).round().astype(np.uint8)


def photo(T_camera_object, one, *, distortion=NO_DISTORTION, only=(3, 7), noise=0.0):
    image = np.full((HEIGHT_PX, WIDTH_PX), 120, dtype=np.uint8)
    for marker in one.markers:
        T = T_camera_object @ transform_from_pose(np.array(marker.pose))
        if marker.id in only and T[:3, 2] @ T[:3, 3] < 0:
            draw(image, marker.id, T, distortion)
    noisy = image + np.random.default_rng(0).normal(scale=noise, size=image.shape)
    return np.repeat(noisy.round().clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def seen_from_above(yaw_rad, shift_m=(0.0, 0.0)):
    """The cube 0.6 m away, seen 40 degrees from above."""
    down = rotation_from_vector(np.array([np.deg2rad(-50.0), 0.0, 0.0])) @ FACING
    R = down @ rotation_from_vector(np.array([0.0, 0.0, yaw_rad]))
    return transform(R, np.array([*shift_m, 0.6]))


def tracked(one, images, Ts_world_camera=None, *, distortion=NO_DISTORTION):
    tracker = MarkerTracker([one], DICTIONARY, K, distortion)
    for index, image in enumerate(images):
        T = np.eye(4) if Ts_world_camera is None else Ts_world_camera[index]
        tracker.add(index * 33_000_000, image, T)
    return tracker.tracked()[one.name]


def errors(found, true):
    way_mm = 1e3 * np.linalg.norm(found[:3, 3] - true[:3, 3])
    return way_mm, np.rad2deg(rotation_angle(found[:3, :3].T @ true[:3, :3]))


def test_gray_images_show_the_same():
    one, true = cube(), seen_from_above(0.3)
    image = photo(true, one)
    found, *others = (tracked(one, [seen]) for seen in (image, image[..., 0], image[..., :1]))
    for other in others:
        np.testing.assert_array_equal(other.Ts_world_object, found.Ts_world_object)


@pytest.mark.long
@pytest.mark.parametrize("distortion", [NO_DISTORTION, DISTORTION], ids=["pinhole", "lens"])
@pytest.mark.parametrize("yaw_rad", [-0.4, 0.0, 0.3])
def test_an_object_is_where_it_was_rendered(yaw_rad, distortion):
    one, true = cube(), seen_from_above(yaw_rad, shift_m=(0.12, -0.05))
    found = tracked(
        one, [photo(true, one, distortion=distortion, noise=2.0)], distortion=distortion
    )
    way_mm, turned_deg = errors(found.Ts_world_object[0], true)
    assert way_mm < 2.0
    assert turned_deg < 1.5
    assert found.reprojection_px[0] < 0.5


@pytest.mark.long
def test_positions_have_no_bias_across_the_view():
    """Half a pixel, between the conventions of two libraries, would be 0.5 mm."""
    one = cube()
    off_mm = []
    for yaw_rad in (-0.4, -0.2, 0.2, 0.4):
        true = seen_from_above(yaw_rad, shift_m=(0.05 * yaw_rad, 0.03))
        found = tracked(one, [photo(true, one)])
        off_mm.append(1e3 * (found.Ts_world_object[0] - true)[:2, 3])
    assert np.abs(np.mean(off_mm, axis=0)).max() < 0.25


@pytest.mark.long
def test_poses_are_in_the_world_of_the_moving_camera():
    one = cube()
    T_world_camera = [
        transform(rotation_from_vector(np.array([0.0, 0.05 * k, 0.0])), np.array([0.02 * k, 0, 0]))
        for k in range(3)
    ]
    T_world_object = seen_from_above(0.2)
    images = [photo(invert(T) @ T_world_object, one) for T in T_world_camera]
    found = tracked(one, images, T_world_camera)
    assert len(found.t_ns) == 3
    assert max(errors(T, T_world_object)[0] for T in found.Ts_world_object) < 2.0


@pytest.mark.long
def test_a_marker_of_another_size_than_stated_is_refused_beside_one_that_is_right():
    one = cube()
    wrong = one.model_copy(
        update={"markers": (one.markers[0].model_copy(update={"size_m": 0.06}), one.markers[1])}
    )
    image = photo(seen_from_above(0.2), one)
    assert len(tracked(wrong, [image]).t_ns) == 0


def test_an_object_without_a_visible_marker_is_not_seen():
    one = cube()
    found = tracked(one, [photo(seen_from_above(0.0), one, only=())])
    assert len(found.t_ns) == 0
    assert found.Ts_world_object.shape == (0, 4, 4)


@pytest.mark.long
def test_a_marker_that_is_there_twice_is_nobodys():
    one = cube()
    image = photo(seen_from_above(0.0, shift_m=(-0.15, 0.0)), one, only=(3,))
    other = photo(seen_from_above(0.0, shift_m=(0.15, 0.0)), one, only=(3,))
    both = np.concatenate([image[:, : WIDTH_PX // 2], other[:, WIDTH_PX // 2 :]], axis=1)
    assert len(tracked(one, [both]).t_ns) == 0


@pytest.mark.long
def test_the_turn_of_a_single_small_marker_follows_its_neighbours():
    """From the front, a distant marker looks the same tilted either way."""
    one = cube().model_copy(update={"markers": (cube().markers[0],)})
    near = [transform(FACING @ rotation_from_vector(np.array([a, 0, 0])), np.array([0, 0, 0.35]))
            for a in (0.5, 0.4, 0.3)]  # fmt: skip
    far = [transform(FACING @ rotation_from_vector(np.array([a, 0, 0])), np.array([0, 0, 1.2]))
           for a in (0.25, 0.2, 0.15, 0.1, 0.05)]  # fmt: skip
    images = [photo(T, one, noise=3.0) for T in (*near, *far)]
    found = tracked(one, images)
    assert len(found.t_ns) >= 6
    true = [(*near, *far)[t // 33_000_000] for t in found.t_ns.tolist()]
    turned = [errors(T, true_T)[1] for T, true_T in zip(found.Ts_world_object, true, strict=True)]
    assert np.median(turned) < 3.0


def test_a_single_jump_between_equal_poses_is_dropped():
    def at(x_m):
        return [_Candidate(transform(np.eye(3), np.array([x_m, 0.0, 0.5])), 0.1)]

    seen = [(k * 33_000_000, at(0.1 if k == 2 else 0.001 * k)) for k in range(5)]
    assert _decided(seen).t_ns.tolist() == [0, 33_000_000, 99_000_000, 132_000_000]
    moving = [(k * 33_000_000, at(0.04 * k)) for k in range(5)]
    assert len(_decided(moving).t_ns) == 5
