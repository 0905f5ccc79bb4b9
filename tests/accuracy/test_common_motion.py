"""Delays of things that were shaken together, against known ones: error, sigma, refusals.

Truth is a smooth rotation of scipy; images are a texture on a sphere, seen by remapping rays.
"""

import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, RotationSpline

from dextouch.errors import InvalidInputError
from services.alignment.calibration.common_motion import (
    Turning,
    shared_times,
    turning_of_images,
    turning_of_points,
    turning_of_rotations,
)
from services.alignment.calibration.motion import DegenerateMotionError

START_NS = 1_700_000_000_000_000_000
SECONDS = 10.0
# Name, rate (Hz), tracking noise (degrees an axis), jitter of its times (s).
STREAMS = (
    ("head", 90, 0.05, 0.0),
    ("wrist_left", 60, 0.1, 1e-3),
    ("wrist_right", 120, 0.1, 0.0),
    ("object", 30, 0.2, 2e-3),
)
K = np.array([[180.0, 0, 160], [0, 180, 120], [0, 0, 1]])
SIZE_PX = (240, 320)


def shake(seed):
    """A brisk irregular rotation, as a function of time."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0, SECONDS + 2, 0.12)
    turns = np.cumsum(0.15 * rng.normal(size=(len(t_s), 3)), axis=0)
    return RotationSpline(t_s, Rotation.from_rotvec(turns))


def stamps_ns(t_s):
    return np.rint(np.asarray(t_s) * 1e9).astype(np.int64) + START_NS


def tracked(truth, rng, rate_hz, noise_deg, jitter_s, delay_s):
    """A tracker with a mount and a world of its own."""
    t_s = np.arange(0.5 + rng.uniform(0, 1 / rate_hz), 0.5 + SECONDS, 1 / rate_hz)
    mount, world = (Rotation.random(random_state=int(rng.integers(1 << 30))) for _ in range(2))
    noise = Rotation.from_rotvec(np.deg2rad(noise_deg) * rng.normal(size=(len(t_s), 3)))
    Rs = (world * truth(t_s) * mount * noise).as_matrix()
    late_s = np.clip(rng.normal(0, jitter_s, len(t_s)), -0.4 / rate_hz, 0.4 / rate_hz)
    return turning_of_rotations(stamps_ns(t_s + delay_s + late_s), Rs)


def shaken(seed):
    rng, truth = np.random.default_rng(1000 + seed), shake(seed)
    delays_s = {name: rng.uniform(0, 0.08) for name, *_ in STREAMS}
    turnings = {name: tracked(truth, rng, *how, delays_s[name]) for name, *how in STREAMS}
    return turnings, delays_s


def errors(found, delays_s):
    """Error and stated standard deviation (ms) of each delay but the reference's."""
    first = found.reference
    return [
        (one.offset_ns * 1e-6 - 1e3 * (delays_s[name] - delays_s[first]), one.sigma_ns * 1e-6)
        for name, one in found.delays.items()
        if name != first
    ]


def report(capsys, what, pairs):
    off_ms, sigma_ms = np.array(pairs).T
    inside = np.mean(np.abs(off_ms) <= 2 * sigma_ms)
    with capsys.disabled():
        sys.stdout.write(
            f"\n{what}: {np.sqrt(np.mean(off_ms**2)):.3f} ms RMS, sigma {np.median(sigma_ms):.3f} "
            f"ms, within two of them {100 * inside:.0f} %"
        )
    return float(np.sqrt(np.mean(off_ms**2))), inside


@pytest.mark.slow
def test_delays_of_a_hundred_shakes(capsys):
    found = []
    for seed in range(100):
        turnings, delays_s = shaken(seed)
        found += errors(shared_times(turnings, "head"), delays_s)
    rms_ms, inside = report(capsys, "four trackers, 100 shakes", found)
    assert rms_ms < 0.3
    assert inside >= 0.95


def test_delays_of_a_shake(capsys):
    turnings, delays_s = shaken(0)
    found = shared_times(turnings, "wrist_left")
    assert len(found.pairs) == 6
    assert found.delays["wrist_left"].sigma_ns == 0
    rms_ms, _ = report(capsys, "four trackers", errors(found, delays_s))
    assert rms_ms < 0.5


def room(seed):
    """Rotation to image: a texture on a sphere, as a pinhole camera sees it, with noise."""
    rng = np.random.default_rng(seed)
    small = cv2.GaussianBlur(rng.integers(0, 255, SIZE_PX, dtype=np.uint8), (0, 0), 1.2)
    sphere = cv2.resize(small, (3000, 3000), interpolation=cv2.INTER_CUBIC)
    sphere = cv2.normalize(sphere, None, 0, 255, cv2.NORM_MINMAX)
    v, u = np.mgrid[0 : SIZE_PX[0], 0 : SIZE_PX[1]] + 0.5
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(SIZE_PX)], -1)
    rays = rays.reshape(-1, 3) / np.linalg.norm(rays.reshape(-1, 3), axis=1, keepdims=True)

    def seen(rotation):
        x, y, z = rotation.apply(rays).T
        columns = (np.arctan2(y, x) / (2 * np.pi) + 0.5) * 2999
        rows = np.arccos(np.clip(z, -1, 1)) / np.pi * 2999
        image = cv2.remap(
            sphere,
            columns.astype(np.float32).reshape(SIZE_PX),
            rows.astype(np.float32).reshape(SIZE_PX),
            cv2.INTER_LINEAR,
        )
        noisy = np.clip(image + rng.normal(0, 4, SIZE_PX), 0, 255).astype(np.uint8)
        return np.repeat(noisy[..., None], 3, axis=2)

    return seen


@pytest.mark.slow
def test_a_camera_against_a_tracker(capsys):
    found = []
    for seed in range(6):
        rng, truth, seen = np.random.default_rng(seed), shake(seed), room(seed)
        delays_s = {"head": rng.uniform(0, 0.08), "camera_head": rng.uniform(0, 0.08)}
        mount = Rotation.random(random_state=seed)
        t_s = np.arange(0.5, 0.5 + SECONDS, 1 / 30)
        images = (seen(truth(t) * mount) for t in t_s)
        camera = turning_of_images(stamps_ns(t_s + delays_s["camera_head"]), images, K, np.zeros(5))
        tracker = tracked(truth, rng, 90, 0.1, 0.0, delays_s["head"])
        both = shared_times({"head": tracker, "camera_head": camera}, "head")
        found += errors(both, delays_s)
    rms_ms, inside = report(capsys, "a camera of 30 Hz, six shakes", found)
    assert rms_ms < 0.3
    assert inside == 1.0


def test_points_that_turn_show_it():
    truth = shake(3)
    t_s = np.arange(0.5, 10.5, 1 / 60)
    points_m = np.random.default_rng(0).normal(scale=0.05, size=(5, 3))
    placed = np.stack([truth(t).apply(points_m) + np.array([0, 0, t]) for t in t_s])
    seen = turning_of_points(stamps_ns(t_s), placed)
    expected = turning_of_rotations(stamps_ns(t_s), truth(t_s).as_matrix())
    # The axes are others, but turn with the points.
    _, off = Rotation.align_vectors(expected.velocity_rad_s, seen.velocity_rad_s)
    assert off < 1e-6


def test_a_bare_wall_shows_nothing():
    walls = np.full((30, 240, 320, 3), 90, dtype=np.uint8)
    for images in (walls, walls[..., :1], walls[..., 0]):
        with pytest.raises(DegenerateMotionError, match=r"0 of 29 steps .* edges"):
            turning_of_images(stamps_ns(np.arange(30) / 30), iter(images), K, np.zeros(5))


def test_a_stream_that_did_not_move_along_is_named():
    turnings, _ = shaken(1)
    turnings["object"] = shaken(2)[0]["object"]
    with pytest.raises(DegenerateMotionError, match="object turned like no stream"):
        shared_times(turnings, "head")


def test_a_clock_that_is_set_within_the_take_is_refused():
    turnings, _ = shaken(4)
    late = turnings["object"]
    set_ns = np.where(np.arange(len(late.t_ns)) < len(late.t_ns) // 2, 0, 30_000_000)
    turnings["object"] = Turning(late.t_ns + set_ns, late.velocity_rad_s)
    with pytest.raises(DegenerateMotionError, match=r"object .* clock stopped or was set"):
        shared_times(turnings, "head")


@pytest.mark.parametrize(("share", "late_s"), [(0.1, 0.015), (0.9, 0.015), (0.5, 0.01)])
def test_a_clock_that_is_set_near_an_end_is_refused(share, late_s):
    turnings, _ = shaken(7)
    late = turnings["wrist_right"]
    is_late = np.arange(len(late.t_ns)) >= share * len(late.t_ns)
    moved = Turning(late.t_ns + np.rint(is_late * late_s * 1e9).astype(int), late.velocity_rad_s)
    with pytest.raises(DegenerateMotionError, match=r"a clock stopped or was set|known only to"):
        shared_times(turnings | {"wrist_right": moved}, "head")


@pytest.mark.parametrize("noise_deg", [0.1, 0.3])
def test_where_circling_makes_up_for_time_the_offset_is_right_or_refused(noise_deg):
    """A turn about the axis of the circle and a shift in time are nearly the same."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        t_s = np.arange(0, SECONDS + 2, 0.05)
        phase = 2 * np.pi * np.cumsum(1 + 0.2 * rng.normal(size=len(t_s)).clip(-2, 2)) * 0.05
        swing = 0.4 * np.column_stack([np.cos(phase), np.sin(phase), 0.05 * np.sin(0.7 * phase)])
        truth = RotationSpline(t_s, Rotation.from_rotvec(swing))
        turnings = {
            name: tracked(truth, rng, rate_hz, noise_deg, 0.0, delay_s)
            for name, rate_hz, delay_s in (("head", 90, 0.0), ("wrist_left", 60, 0.03))
        }
        try:
            found = shared_times(turnings, "head").delays["wrist_left"]
        except DegenerateMotionError:
            continue
        assert abs(found.offset_ns - 30e6) <= 3 * found.sigma_ns


def test_too_few_streams_and_an_unknown_reference():
    turnings, _ = shaken(0)
    with pytest.raises(InvalidInputError, match="two streams at least"):
        shared_times({"head": turnings["head"]}, "head")
    with pytest.raises(InvalidInputError, match="'table'"):
        shared_times(turnings, "table")
