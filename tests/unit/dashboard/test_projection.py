"""The page's 3-D view projects as OpenCV does and places hands as NumPy does; run by node."""

import base64
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from dextouch.hands import mean_hand_m
from dextouch.tactile import DEXTOUCH_V1, PADS
from dextouch.tactile.layout import split_pads
from services.dashboard.app import STATIC
from services.dashboard.feeds import heatmap_layout, pose_message, skeleton_bones
from tests.unit.other_gloves import small_layout

# Vertical field of view of static/poses.js.
FOVY_RAD = 0.7
NODE = shutil.which("node")


def camera_case(rng):
    """An orbit camera, points in front of it, and their pixels by OpenCV."""
    target, distance = rng.normal(0, 1, 3), rng.uniform(0.3, 3)
    azimuth, elevation = rng.uniform(-4, 4), rng.uniform(-1.4, 1.4)
    width, height = int(rng.integers(200, 900)), int(rng.integers(200, 900))
    position = target + distance * np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    forward = (target - position) / distance
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R_camera_world = np.stack([right, np.cross(forward, right), forward])
    points = target + rng.uniform(-0.2, 0.2, (6, 3)) * distance
    focal = height / 2 / np.tan(FOVY_RAD / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    rotation_vector = cv2.Rodrigues(R_camera_world)[0]
    translation = -R_camera_world @ position
    pixels = cv2.projectPoints(points, rotation_vector, translation, K, None)[0].reshape(-1, 2)
    orbit = {"target_m": target.tolist(), "distance_m": distance}
    orbit |= {"azimuth_rad": azimuth, "elevation_rad": elevation}
    size = {"width_px": width, "height_px": height}
    return {
        "orbit": orbit,
        "size": size,
        "points": points.tolist(),
        "pixels": pixels.tolist(),
    }


def taxel_places():
    """Taxel, pad, row and column from 1, of all taxels, by `split_pads`."""
    tips, palm = split_pads(np.arange(320))
    pads = [*zip(PADS, tips, strict=False), (PADS[-1], palm)]
    return [
        (int(taxel), name, row + 1, column + 1)
        for name, pad in pads
        for (row, column), taxel in np.ndenumerate(pad)
    ]


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_projection_in_node(tmp_path):
    rng = np.random.default_rng(5)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T_world_wrist = np.eye(4)
    T_world_wrist[:3, :3], T_world_wrist[:3, 3] = R, rng.normal(size=3)
    hands = {side: np.array(mean_hand_m(side)) for side in ("left", "right")}
    ages_s = {"head": None, "wrist_left": 0.01, "wrist_right": 7.5}
    ages_s |= {"keypoints_left": 0.02, "keypoints_right": 0.03}
    arrays = {f"keypoints_{side}": points.astype(np.float32) for side, points in hands.items()}
    message = pose_message(ages_s, arrays | {"wrist_left": T_world_wrist.astype(np.float32)})
    cases = {
        "cameras": [camera_case(rng) for _ in range(30)],
        "message": base64.b64encode(message).decode(),
        "sides": {"left": (hands["left"] @ R.T + T_world_wrist[:3, 3]).tolist()},
    }
    pressures = rng.uniform(0, 40, 320).astype(np.float32)
    cases |= {"pressures": pressures.tolist(), "names": taxel_places()}
    cases["heatmap"], other = heatmap_layout(), small_layout()
    cases["layout"] = other.model_dump(mode="json")
    taxels = np.arange(138, dtype=np.float32)
    cases["canvases"] = {
        side: np.nan_to_num(other.hand_canvas(taxels, side=side), nan=-1).ravel().tolist()
        for side in ("left", "right")
    }
    cases["own_canvases"] = {
        side: np.nan_to_num(DEXTOUCH_V1.hand_canvas(np.arange(320.0), side=side), nan=-1)
        .ravel()
        .tolist()
        for side in ("left", "right")
    }
    cases["own_layout"] = DEXTOUCH_V1.model_dump(mode="json")
    cases["forces"] = DEXTOUCH_V1.pad_forces_n(pressures[None])[0].tolist()
    path = tmp_path / "cases.json"
    path.write_text(json.dumps(cases))
    script = Path(__file__).parent / "js" / "projection.test.mjs"
    result = subprocess.run(
        [NODE, "--test", script],
        env={**os.environ, "STATIC": str(STATIC), "CASES": str(path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_bones_are_those_of_a_hand():
    """24 bones join 25 keypoints to one tree, and none is longer than a metacarpal."""
    bones, points = np.array(skeleton_bones()), mean_hand_m("right")
    assert sorted(bones[:, 1]) == list(range(1, 25))
    assert (bones[:, 0] < bones[:, 1]).all()
    lengths = np.linalg.norm(points[bones[:, 0]] - points[bones[:, 1]], axis=1)
    assert lengths.max() < 0.07
