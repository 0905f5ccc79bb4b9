"""Images that OpenCV projects for a camera that turns before a far wall, with its poses."""

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 160, 120, 150.0
K = np.array([[FOCAL_PX, 0, WIDTH_PX / 2], [0, FOCAL_PX, HEIGHT_PX / 2], [0, 0, 1]])
RATE_HZ = 30
# Of poses.
POSE_NS = 10_000_000


def turns(seed, seconds, calm=25):
    """Rotations R_world_camera at 100 Hz of a head that looks around, with 0.1 rad of scatter."""
    waves = np.random.default_rng(seed).standard_normal((round(seconds * 100), 3))
    waves = gaussian_filter1d(waves, calm, axis=0, mode="wrap")
    return Rotation.from_euler("yxz", waves / waves.std(axis=0) * [0.1, 0.08, 0.03])


def poses(seed, seconds, calm=25):
    """T_world_camera at 100 Hz."""
    Ts = np.tile(np.eye(4), (round(seconds * 100), 1, 1))
    Ts[:, :3, :3] = turns(seed, seconds, calm).as_matrix()
    return np.arange(len(Ts)) * POSE_NS, Ts


def images(seed, seconds, late_s=0.0, calm=25):
    """Times and images [n, 120, 160, 3] at 30 Hz with noise, of `late_s` before their times."""
    rng = np.random.default_rng([seed, 1])
    wall = cv2.GaussianBlur(rng.uniform(0, 255, (600, 800, 3)), (0, 0), 9)
    wall = np.clip((wall - wall.mean()) * 8 + 120, 20, 235).astype(np.uint8)
    t_ns = np.rint(np.arange(round(seconds * RATE_HZ)) * (1e9 / RATE_HZ)).astype(np.int64)
    shown = np.rint((t_ns - late_s * 1e9) / POSE_NS).astype(int) % round(seconds * 100)
    # Pixels of the wall by rays of the world: its camera looks along z from the same place.
    wall_K = np.array([[FOCAL_PX, 0, 400], [0, FOCAL_PX, 300], [0, 0, 1]])
    size = (WIDTH_PX, HEIGHT_PX)
    homographies = wall_K @ turns(seed, seconds, calm)[shown].as_matrix() @ np.linalg.inv(K)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    clean = np.stack([cv2.warpPerspective(wall, H, size, flags=flags) for H in homographies])
    return t_ns, np.clip(clean + rng.normal(0, 3, clean.shape), 0, 255).astype(np.uint8)
