"""Photos of a calibration board, rendered from where the camera is."""

import cv2
import numpy as np

from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import transform

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
