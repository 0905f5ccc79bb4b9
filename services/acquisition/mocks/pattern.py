"""Made-up streams of two moving, pressing hands."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.geometry import pinhole_matrix
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import CHAINS, chain_indices, mean_hand_m
from dextouch.schemas import Matrix, matrix_rows
from dextouch.streams import StreamDescriptor, StreamKind
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side, join_pads
from services.acquisition.mocks.replay import ReplayStream

IMAGE_PX = 64
FOVY_RAD = 1.0
PEAK_KPA = 30.0
# Patches of the cameras' ground: as large as the squares that the image check looks at.
PATCH_PX = 4
PATCH_CONTRAST = 20
ROUND_S = 8.0


def pattern_streams(round_s: float = ROUND_S) -> list[ReplayStream]:
    """All human streams of one round; the end meets the beginning."""

    def turns_rad(rate_hz: float) -> Float64[np.ndarray, " n"]:
        count = round(rate_hz * round_s)
        return 2 * np.pi * np.arange(count) / count

    images, poses_rad = _images(turns_rad(30.0)), turns_rad(100.0)
    head = _poses(0.2 * np.sin(poses_rad), np.array([0.0, -0.2, 1.5]))
    streams = []
    for index, side in enumerate(SIDES):
        pressures = _pressures(turns_rad(60.0) + np.pi * index)
        wrist = _poses(poses_rad, np.array([0.4 * index - 0.2, 0.3, 1.0]))
        streams += [
            _stream(f"tactile_{side}", "tactile", (60.0, "kPa"), pressures),
            _stream(
                f"keypoints_{side}", "keypoints", (120.0, "m"), _keypoints(turns_rad(120.0), side)
            ),
            _stream(f"wrist_{side}", "pose", (100.0, "pose_m_wxyz"), wrist),
            _stream(f"camera_wrist_{side}", "image", (30.0, "rgb8"), images),
        ]
    streams.append(_stream("head", "pose", (100.0, "pose_m_wxyz"), head))
    streams.append(_stream("camera_head", "image", (30.0, "rgb8"), images))
    return streams


def pattern_calibration() -> dict[str, Matrix]:
    """The matrix of the made-up head camera, which alignment asks for."""
    K_head = pinhole_matrix(width_px=IMAGE_PX, height_px=IMAGE_PX, fovy_rad=FOVY_RAD)
    return {"K_head": matrix_rows(K_head)}


def _stream(
    name: str, kind: StreamKind, rate_and_unit: tuple[float, str], values: np.ndarray
) -> ReplayStream:
    rate_hz, unit = rate_and_unit
    t_ns = np.rint(np.arange(len(values)) * (1e9 / rate_hz)).astype(np.int64)
    descriptor = StreamDescriptor.model_validate(
        {
            "name": name,
            "kind": kind,
            "shape": values.shape[1:],
            "dtype": values.dtype.name,
            "unit": unit,
            "nominal_rate_hz": rate_hz,
        }
    )
    return ReplayStream(descriptor, t_ns, values)


def _pressures(turn_rad: np.ndarray) -> Float32[np.ndarray, "n 320"]:
    """Fingers press one after the other; a bump wanders around the palm."""
    finger_rad = turn_rad[:, None] - np.arange(5) * (2 * np.pi / 5)
    force = np.maximum(0.0, np.cos(finger_rad)) ** 2
    rows, columns = np.mgrid[0:4, 0:4]
    tip = np.exp(-((rows - 1.5) ** 2 + (columns - 1.5) ** 2) / 3.0)
    tips = force[..., None, None] * tip
    rows, columns = np.mgrid[0:15, 0:16]
    centre_row = 7 + 4 * np.cos(turn_rad)[:, None, None]
    centre_column = 7.5 + 5 * np.sin(turn_rad)[:, None, None]
    palm = np.exp(-((rows - centre_row) ** 2 + (columns - centre_column) ** 2) / 6.0)
    pressures = PEAK_KPA * join_pads(tips, palm)
    return pressures.reshape(len(turn_rad), NUM_TAXELS).astype(np.float32)


def _keypoints(turn_rad: np.ndarray, side: Side) -> Float64[np.ndarray, "n 25 3"]:
    """The mean hand opens and closes: each finger bends towards the palm, in wrist axes."""
    hand = mean_hand_m(side)
    points = np.repeat(hand[None], len(turn_rad), axis=0)
    palm = 1.0 if side == "right" else -1.0
    bend_rad = palm * 0.35 * (1 - np.cos(turn_rad))
    for chain in CHAINS:
        # The three bones beyond the palm, or beyond the base of the thumb.
        nodes = chain_indices(chain)[-4:]
        for joint, (parent, node) in enumerate(pairwise(nodes), start=1):
            turned = np.zeros((len(turn_rad), 3))
            turned[:, 0] = joint * bend_rad
            bone = hand[node] - hand[parent]
            points[:, node] = points[:, parent] + rotation_from_vector(turned) @ bone
    return points


def _poses(turn_rad: np.ndarray, centre_m: np.ndarray) -> Float64[np.ndarray, "n 7"]:
    poses = np.zeros((len(turn_rad), 7))
    circle = np.stack([np.cos(turn_rad), np.sin(turn_rad), np.sin(2 * turn_rad)], axis=-1)
    poses[:, :3] = centre_m + 0.05 * circle
    angle_rad = 0.3 * np.sin(turn_rad)
    poses[:, 3], poses[:, 6] = np.cos(angle_rad / 2), np.sin(angle_rad / 2)
    return poses


def _images(turn_rad: np.ndarray) -> UInt8[np.ndarray, "n 64 64 3"]:
    """A ball rolls over patches, whose edges keep every image about as sharp as the others."""
    rows, columns = np.mgrid[0:IMAGE_PX, 0:IMAGE_PX]
    centre_row = IMAGE_PX * (0.5 + 0.3 * np.sin(turn_rad))[:, None, None]
    centre_column = IMAGE_PX * (0.5 + 0.3 * np.cos(turn_rad))[:, None, None]
    ball = np.hypot(rows - centre_row, columns - centre_column) < IMAGE_PX / 8
    patches = PATCH_CONTRAST * ((rows // PATCH_PX + columns // PATCH_PX) % 2)
    ground = np.broadcast_to(40 + rows + columns + patches, ball.shape)
    red = np.where(ball, 230, ground)
    return np.stack([red, np.where(ball, 120, ground), ground], axis=-1).astype(np.uint8)
