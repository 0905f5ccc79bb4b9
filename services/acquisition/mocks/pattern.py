"""Made-up streams: two moving, pressing hands, and a board, trackers and gloves to calibrate."""

from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.geometry import invert, pinhole_matrix, pose_from_transform, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import CHAINS, chain_indices, mean_hand_m
from dextouch.schemas import Matrix, matrix_rows
from dextouch.streams import StreamDescriptor, StreamKind
from dextouch.tactile import PADS
from dextouch.tactile.layout import DEXTOUCH_V1, SIDES, Side, TactileLayout
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.replay import ReplayStream

IMAGE_PX = 64
FOVY_RAD = 1.0
PEAK_KPA = 30.0
# Patches of the cameras' ground: as large as the squares that the image check looks at.
PATCH_PX = 4
PATCH_CONTRAST = 20
ROUND_S = 8.0
# The practice camera as it is: calibration has to find this out from its images. The first pixel
# spans 0 … 1; distortion is k1 k2 p1 p2 of OpenCV's model.
SIZE_PX: Final = (480, 360)
K: Final = np.array([[431.7, 0.0, 244.6], [0.0, 429.2, 176.3], [0.0, 0.0, 1.0]])
DISTORTION: Final = (-0.11, 0.06, 0.0012, -0.0009)
# chessboard:9x6:25mm
COLUMNS, ROWS, SQUARE_M = 9, 6, 0.025
RIM_M = 0.02
RATE_HZ = 10.0
MOVING_IMAGES, NUM_POSES = 3, 40
# Images at rest at each pose in turn: motion that repeats itself shows no delay.
STILL_IMAGES: Final = (6, 8, 12, 7, 10, 6, 9)
NOISE_COUNTS = 1.5
# Width of an edge in pixels, as that of a lens in focus.
EDGE_PX = 1.6
DEPTHS_M = (0.42, 0.55, 0.72)
TILTS_RAD = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5), (0.0, 0.0))
PAPER, INK, WALL = 225.0, 30.0, 125.0
# Where the practice camera sits on its tracker, and its board in the world: calibration has to find
# out the first. The board hangs upright in front of a head at 1.45 m; z is up.
T_TRACKER_CAMERA: Final = transform(
    rotation_from_vector(np.array([-1.9, 0.12, 0.2])), np.array([0.031, 0.046, -0.052])
)
T_WORLD_BOARD: Final = transform(
    np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.array([0.0, 0.35, 1.45])
)
# Of the practice trackers at each place, per axis (rad, m): a good room-scale tracker.
PLACE_SIGMA: Final = (np.deg2rad(0.03), 3e-4)
# All practice trackers are strapped together.
T_HEAD_WRISTS: Final = {
    "wrist_left": transform(
        rotation_from_vector(np.array([0.3, -0.8, 0.5])), np.array([-0.1, 0.0, 0.0])
    ),
    "wrist_right": transform(
        rotation_from_vector(np.array([-0.4, 0.6, 1.1])), np.array([0.1, 0.0, 0.0])
    ),
}
# Delays of their paths, which calibration has to find out, and the noise of each pose.
PRACTICE_FAULTS: Final = {
    f"pose_tracker_{name}": DeviceFaults(
        path_delay_ms=delay_ms, position_noise_m=1e-4, rotation_noise_rad=float(np.deg2rad(0.02))
    )
    for name, delay_ms in (("head", 0.0), ("wrist_left", 12.0), ("wrist_right", 5.0))
}
POSE_RATE_HZ = 100.0
# Kind, unit and usual rate of streams, by the beginning of their names.
ROLES: Final[dict[str, tuple[StreamKind, str, float]]] = {
    "tactile": ("tactile", "kPa", 60.0),
    "keypoints": ("keypoints", "m", 120.0),
    "wrist": ("pose", "pose_m_wxyz", POSE_RATE_HZ),
    "head": ("pose", "pose_m_wxyz", POSE_RATE_HZ),
    "camera": ("image", "rgb8", 30.0),
}


def pattern_streams(
    round_s: float = ROUND_S, *, layout: TactileLayout | None = None
) -> list[ReplayStream]:
    """All human streams of one round; the end meets the beginning.

    `layout` is that of the gloves; None for `dextouch_v1`.
    """
    glove = layout or DEXTOUCH_V1

    def turns_rad(rate_hz: float) -> Float64[np.ndarray, " n"]:
        count = round(rate_hz * round_s)
        return 2 * np.pi * np.arange(count) / count

    images, poses_rad = _images(turns_rad(30.0)), turns_rad(100.0)
    head = _poses(0.2 * np.sin(poses_rad), np.array([0.0, -0.2, 1.5]))
    streams = []
    for index, side in enumerate(SIDES):
        pressures = _pressures(turns_rad(glove.nominal_rate_hz) + np.pi * index, glove)
        wrist = _poses(poses_rad, np.array([0.4 * index - 0.2, 0.3, 1.0]))
        streams += [
            _stream(f"tactile_{side}", pressures, glove.nominal_rate_hz, layout),
            _stream(f"keypoints_{side}", _keypoints(turns_rad(120.0), side)),
            _stream(f"wrist_{side}", wrist),
            _stream(f"camera_wrist_{side}", images),
        ]
    return [*streams, _stream("head", head), _stream("camera_head", images)]


def pattern_calibration() -> dict[str, Matrix]:
    """The matrix of the made-up head camera, which alignment asks for."""
    K_head = pinhole_matrix(width_px=IMAGE_PX, height_px=IMAGE_PX, fovy_rad=FOVY_RAD)
    return {"K_head": matrix_rows(K_head)}


def _stream(
    name: str,
    values: np.ndarray,
    rate_hz: float | None = None,
    layout: TactileLayout | None = None,
) -> ReplayStream:
    kind, unit, usual_hz = ROLES[name.partition("_")[0]]
    rate_hz = rate_hz or usual_hz
    t_ns = np.rint(np.arange(len(values)) * (1e9 / rate_hz)).astype(np.int64)
    descriptor = StreamDescriptor.model_validate(
        {
            "name": name,
            "kind": kind,
            "shape": values.shape[1:],
            "dtype": values.dtype.name,
            "unit": unit,
            "nominal_rate_hz": rate_hz,
            "layout": layout,
        }
    )
    return ReplayStream(descriptor, t_ns, values)


def _pressures(turn_rad: np.ndarray, layout: TactileLayout) -> Float32[np.ndarray, "n taxels"]:
    """Fingers press one after the other; a bump wanders around the palm."""
    finger_rad = turn_rad[:, None] - np.arange(5) * (2 * np.pi / 5)
    force = np.maximum(0.0, np.cos(finger_rad)) ** 2
    pads = []
    for pad in layout.pads:
        rows, columns = np.mgrid[0 : pad.rows, 0 : pad.columns]
        centre_row, centre_column = (pad.rows - 1) / 2, (pad.columns - 1) / 2
        if pad.part == "palm":
            across = centre_column + 5 / 16 * pad.columns * np.sin(turn_rad)[:, None, None]
            along = centre_row + 4 / 15 * pad.rows * np.cos(turn_rad)[:, None, None]
            bump = np.exp(-((rows - along) ** 2 + (columns - across) ** 2) / 6.0)
        else:
            tip = np.exp(-((rows - centre_row) ** 2 + (columns - centre_column) ** 2) / 3.0)
            bump = force[:, PADS.index(pad.part), None, None] * tip
        pads.append(bump.reshape(len(turn_rad), -1))
    return (PEAK_KPA * np.concatenate(pads, axis=1)).astype(np.float32)


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


def practice_streams(seed: int = 0, *, layout: TactileLayout | None = None) -> list[ReplayStream]:
    """All human streams, with a board before the head camera, on its tracker, and gloves at rest.

    The trackers of head and wrists move as one body.
    """
    images = board_images(seed)
    board = _stream("camera_head", images, RATE_HZ)
    # One round for all: a shorter stream would pause until the board is done.
    others = pattern_streams(len(images) / RATE_HZ, layout=layout)
    heads = _practice_heads(seed)
    moved = {"head": heads} | {name: heads @ T for name, T in T_HEAD_WRISTS.items()}
    poses = [_stream(name, pose_from_transform(Ts)) for name, Ts in moved.items()]
    hands = [s for s in others if s.descriptor.kind == "keypoints"]
    gloves = [s for s in others if s.descriptor.kind == "tactile"]
    rest = [replace(glove, values=np.zeros_like(glove.values)) for glove in gloves]
    return [*hands, *rest, *poses, board]


def _practice_heads(seed: int) -> Float64[np.ndarray, "n 4 4"]:
    """Poses T_world_tracker of the head that see the board as `board_images` shows it."""
    places = np.array([*_board_poses(), _board_poses()[0]])
    errors = np.random.default_rng([seed, 1]).normal(size=places.shape)
    errors[:, :3] *= PLACE_SIGMA[0]
    errors[:, 3:] *= PLACE_SIGMA[1]
    errors[-1] = errors[0]
    # The camera starts to move after its last still image.
    steps = np.array([[num_still - 1, MOVING_IMAGES + 1] for num_still in _rests()])
    begins = np.cumsum(steps.ravel()) - steps.ravel()
    image = np.arange(steps.sum() * round(POSE_RATE_HZ / RATE_HZ)) * RATE_HZ / POSE_RATE_HZ
    phases = [*np.repeat(np.arange(NUM_POSES), 2), NUM_POSES]
    phase = np.interp(image, [*begins, steps.sum()], phases)
    place = np.minimum(phase.astype(int), NUM_POSES - 1)
    share = (phase - place)[:, None]
    boards, error = ((1 - share) * a[place] + share * a[place + 1] for a in (places, errors))
    Ts_camera_board = np.array([board_pose(pose) for pose in boards])
    heads = T_WORLD_BOARD @ invert(T_TRACKER_CAMERA @ Ts_camera_board)
    return heads @ transform(rotation_from_vector(error[:, :3]), error[:, 3:])


def board_images(seed: int) -> UInt8[np.ndarray, "n h w 3"]:
    """Images of the board, which rests at each pose and then moves to the next one."""
    rng, rays = np.random.default_rng(seed), _rays()
    poses = _board_poses()
    grey = []
    for (here, there), num_still in zip(pairwise([*poses, poses[0]]), _rests(), strict=True):
        still = render(here, rays)
        moving = [
            render(here + share * (there - here), rays)
            for share in np.linspace(0, 1, MOVING_IMAGES + 2)[1:-1]
        ]
        grey += [still] * num_still + moving
    images = np.empty((len(grey), *rays.shape[:2]), dtype=np.uint8)
    for image, clean in zip(images, grey, strict=True):
        noise = NOISE_COUNTS * rng.standard_normal(clean.shape, dtype=np.float32)
        image[:] = np.clip(np.rint(clean + noise), 0, 255)
    # Three equal channels without three copies.
    return np.broadcast_to(images[..., None], (*images.shape, 3))


def render(pose: np.ndarray, rays: Float64[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Grey image of a board at a pose [6] in the camera: rotation vector, its middle (m)."""
    T_camera_board = board_pose(pose)
    normal, origin = T_camera_board[:3, 2], T_camera_board[:3, 3]
    points = rays * ((normal @ origin) / (rays @ normal))[..., None] - origin
    x, y = (points @ T_camera_board[:3, axis] / SQUARE_M for axis in (0, 1))
    edge_x, edge_y = _edge(x), _edge(y)
    ink = _stripes(x, edge_x) * _stripes(y, edge_y)
    rim = RIM_M / SQUARE_M
    squares = _inside(x, edge_x, -1.0, float(COLUMNS)) * _inside(y, edge_y, -1.0, float(ROWS))
    paper = _inside(x, edge_x, -1 - rim, COLUMNS + rim) * _inside(y, edge_y, -1 - rim, ROWS + rim)
    sheet = PAPER + squares * 0.5 * (1 + ink) * (INK - PAPER)
    return (WALL + paper * (sheet - WALL)).astype(np.float32)


def board_pose(pose: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """T_camera_board of a rotation vector and the place of the board's middle (m)."""
    R = rotation_from_vector(pose[:3])
    middle = np.array([(COLUMNS - 1) * SQUARE_M / 2, (ROWS - 1) * SQUARE_M / 2, 0.0])
    return transform(R, pose[3:] - R @ middle)


def _stripes(a: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """+1 and -1 in turn between whole numbers, with edges as wide as a lens makes them."""
    cell = np.floor(a)
    distance = (0.5 - np.abs(a - cell - 0.5)) * np.where(cell % 2, 1.0, -1.0)
    return 2 * np.clip(distance / edge, -0.5, 0.5)


def _inside(a: np.ndarray, edge: np.ndarray, low: float, high: float) -> np.ndarray:
    """1 between two values, 0 outside of them."""
    return np.clip(np.minimum(a - low, high - a) / edge + 0.5, 0, 1)


def _edge(a: np.ndarray) -> np.ndarray:
    """Change of `a` over the width of an edge in the image."""
    down, right = np.gradient(a)
    return EDGE_PX * np.hypot(down, right)


def _rays() -> Float64[np.ndarray, "h w 3"]:
    """Direction of every pixel's centre, by fixed-point iteration of OpenCV's distortion."""
    v, u = np.mgrid[0 : SIZE_PX[1], 0 : SIZE_PX[0]] + 0.5
    x_seen, y_seen = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    k1, k2, p1, p2 = DISTORTION
    x, y = x_seen, y_seen
    for _ in range(20):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (x_seen - dx) / radial, (y_seen - dy) / radial
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _rests() -> list[int]:
    """Number of images at rest at each pose."""
    return [STILL_IMAGES[index % len(STILL_IMAGES)] for index in range(NUM_POSES)]


def _board_poses() -> list[Float64[np.ndarray, "6"]]:
    """Everywhere in the image, near and far, tilted towards each edge."""
    poses = []
    for index in range(NUM_POSES):
        depth = DEPTHS_M[index % len(DEPTHS_M)]
        across, down = (index * 3 % 5 - 2) / 2, (index * 3 // 5 % 5 - 2) / 2
        # As far out as the whole board with its rim stays in the image.
        reach_x, reach_y = 0.54 * depth - 0.15, 0.40 * depth - 0.11
        tilt = TILTS_RAD[index * 2 % len(TILTS_RAD)]
        roll = 0.15 * ((index * 7) % 5 - 2)
        poses.append(np.array([*tilt, roll, across * reach_x, down * reach_y, depth]))
    return poses
