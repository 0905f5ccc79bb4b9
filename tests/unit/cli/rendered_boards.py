"""Photos of a calibration board, rendered from where the camera is."""

import cv2
import numpy as np

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector

# In DexTouch's pixels: the first one spans 0 … 1.
K = np.array([[520.0, 0.0, 325.3], [0.0, 515.0, 236.8], [0.0, 0.0, 1.0]])
BOARD = "chessboard:9x6:25mm"
SQUARE_PX = 40
SIZE = (640, 480)


def render(T_camera_board):
    """A sharp photo of a 9 by 6 board whose first inner corner is the origin."""
    rows, columns = np.indices((9 * SQUARE_PX, 12 * SQUARE_PX))
    dark = (rows // SQUARE_PX + columns // SQUARE_PX) % 2 == 0
    dark[:SQUARE_PX], dark[-SQUARE_PX:], dark[:, :SQUARE_PX], dark[:, -SQUARE_PX:] = 0, 0, 0, 0
    metre = 0.025 / SQUARE_PX
    # The picture's corner (0, 0) lies between pixels; its second inner corner at two squares.
    to_board = np.array([[metre, 0, -0.05], [0, metre, -0.05], [0, 0, 1]])
    finer, half = np.diag([3.0, 3.0, 1.0]), np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    plane = T_camera_board[:3, [0, 1, 3]]
    homography = np.linalg.inv(half) @ finer @ K @ plane @ to_board @ half
    picture = cv2.warpPerspective(
        np.where(dark, 30, 225).astype(np.uint8),
        homography,
        (3 * SIZE[0], 3 * SIZE[1]),
        flags=cv2.INTER_LINEAR,
        borderValue=225,
    )
    return cv2.GaussianBlur(cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.7)


def board_at(place_m, turn_rad):
    """T_camera_board with the board's middle at a place."""
    R = rotation_from_vector(np.asarray(turn_rad, dtype=float))
    return transform(R, np.asarray(place_m, dtype=float) - R @ np.array([0.1, 0.0625, 0.0]))


def good_views():
    """25 views: every ninth of the image, four tilts, near and far."""
    rng = np.random.default_rng(0)
    views = []
    for index in range(25):
        depth = (0.36, 0.45, 0.6)[index % 3]
        share = np.array([(index % 5 - 2) / 2, (index // 5 - 2) / 2])
        # As far out as the whole board, white rim included, stays in the image.
        reach = np.array([0.6 * depth - 0.15, 0.45 * depth - 0.12])
        place = np.array([*(share * reach), depth])
        tilt = [(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)][index % 4]
        views.append(board_at(place, [*tilt, 0.2 * rng.normal()]))
    return views


def write_photos(folder, views):
    folder.mkdir(parents=True)
    for index, view in enumerate(views):
        cv2.imwrite(str(folder / f"photo_{index:02d}.png"), render(view))
    return folder


CHARUCO = "charuco:5x7:30mm:22mm"
CHARUCO_SIZE = (960, 540)
CHARUCO_K = np.array([[683.0, 0.0, 481.2], [0.0, 679.0, 268.9], [0.0, 0.0, 1.0]])
DISTORTION = np.array([0.05, -0.1, 0.001, -0.0005, 0.02])
_SQUARE_M, _MARKER_M, _CHARUCO_SQUARE_PX, _FINER = 0.03, 0.022, 120, 2


class CharucoCamera:
    """Renders a ChArUco board of 5 by 7 squares through a lens with distortion."""

    def __init__(self):
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
        board = cv2.aruco.CharucoBoard((5, 7), _SQUARE_M, _MARKER_M, dictionary)
        size = (5 * _CHARUCO_SQUARE_PX, 7 * _CHARUCO_SQUARE_PX)
        print_ = np.clip(board.generateImage(size, marginSize=0), 30, 225).astype(np.uint8)
        # A white rim of a square, as paper has it.
        rim = _CHARUCO_SQUARE_PX
        self._print = cv2.copyMakeBorder(print_, *[rim] * 4, cv2.BORDER_CONSTANT, value=225)
        width, height = CHARUCO_SIZE[0] * _FINER, CHARUCO_SIZE[1] * _FINER
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        pixels = np.stack([x.ravel(), y.ravel()], axis=-1) / _FINER
        rays = cv2.undistortPoints(pixels[:, None], CHARUCO_K, DISTORTION)[:, 0]
        rays = np.column_stack([rays, np.ones(len(rays))])
        self._rays = rays.astype(np.float32)
        self._shape = (height, width)

    def render(self, T_camera_board):
        """A sharp photo, grey."""
        to_board = np.linalg.inv(T_camera_board[:3, [0, 1, 3]]).astype(np.float32)
        x, y, w = to_board @ self._rays.T
        scale = _CHARUCO_SQUARE_PX / _SQUARE_M
        # OpenCV's picture of the board: the middle of its first pixel is 0, 0.
        across, down = (scale * v / w + _CHARUCO_SQUARE_PX - 0.5 for v in (x, y))
        fine = cv2.remap(
            self._print,
            across.reshape(self._shape),
            down.reshape(self._shape),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=120,
        )
        photo = cv2.resize(fine, CHARUCO_SIZE, interpolation=cv2.INTER_AREA)
        return cv2.GaussianBlur(photo, (0, 0), 0.7)


def smeared(photo, shift_px):
    """A photo during which all moved by `shift_px` (x, y), from where it was on."""
    steps = np.linspace(0, 1, 25)
    moved = [
        cv2.warpAffine(
            photo,
            np.array([[1, 0, share * shift_px[0]], [0, 1, share * shift_px[1]]]),
            photo.shape[::-1],
            borderMode=cv2.BORDER_REPLICATE,
        ).astype(np.float64)
        for share in steps
    ]
    return np.rint(np.mean(moved, axis=0)).astype(np.uint8)


def charuco_views(rng, num):
    """Poses T_camera_board that show the whole board, turned about all axes, near and far."""
    outline = np.array([[x, y, 0.0] for x in (0, 0.15) for y in (0, 0.21)])
    views = []
    while len(views) < num:
        R = rotation_from_vector(np.deg2rad(35) * rng.uniform(-1, 1, 3))
        middle = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.42, 0.7)])
        T = transform(R, middle - R @ outline.mean(axis=0))
        seen = (outline @ R.T + T[:3, 3]) @ CHARUCO_K.T
        seen = seen[:, :2] / seen[:, 2:]
        if (seen > 15).all() and (seen < np.array(CHARUCO_SIZE) - 15).all():
            views.append(T)
    return views


def board_filling_the_image(turn_rad):
    """A near view, on which the board is found even when it moved by six pixels."""
    R = rotation_from_vector(np.array([turn_rad, 2 * turn_rad, np.pi / 2]))
    return transform(R, np.array([0.0, 0.0, 0.31]) - R @ np.array([0.075, 0.105, 0.0]))
