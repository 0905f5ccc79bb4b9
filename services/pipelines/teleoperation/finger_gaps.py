"""Gaps between the fingers of a robot hand, and how far a movement may go before fingers touch.

Links are capsules around the lines between the knuckle, the joints and the tip, as in the twin.
"""

from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import ShapeError
from dextouch.hands.robot_hand import HandModel

NUM_LINKS: Final = 3  # capsules of a finger, between its four points
# A movement is checked at these shares of it. At 9.6 rad/s and 60 Hz a fingertip moves 16 mm in a
# period: 2 mm between two checks, an eighth of a finger's thickness.
SHARES: Final = np.linspace(0.0, 1.0, 9)
# Of floating-point numbers, so that a hand at rest is not nearer to itself than it is.
TOLERANCE_M: Final = 1e-12


class FingerGaps:
    """Distances between the surfaces of a hand's fingers, and movements that keep them.

    The palm is not among them. `radii_m` [fingers, 3] are those of the links knuckle-PIP, PIP-DIP
    and DIP-tip; the tip is on the surface: the last capsule ends one radius before it. Raises
    ShapeError for other radii than three a finger.
    """

    def __init__(self, hand: HandModel, radii_m: np.ndarray) -> None:
        radii = np.asarray(radii_m, dtype=np.float64)
        num_fingers = len(hand.fingers)
        if radii.shape != (num_fingers, NUM_LINKS):
            raise ShapeError(
                f"radii of the fingers: got {list(radii.shape)}, expected [{num_fingers}, 3]"
            )
        self._hand = hand
        self._tip_radii_m = radii[:, -1]
        # Pairs of fingers, and of each all pairs of their links, numbered through all fingers.
        self.pairs = np.array(list(combinations(range(num_fingers), 2)), dtype=int).reshape(-1, 2)
        one, other = np.divmod(np.arange(NUM_LINKS**2), NUM_LINKS)
        self._first = self.pairs[:, :1] * NUM_LINKS + one
        self._second = self.pairs[:, 1:] * NUM_LINKS + other
        self._both_radii_m = radii.ravel()[self._first] + radii.ravel()[self._second]

    def gaps_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time pairs"]:
        """Gap of each of `pairs` at finite angles [T, J], negative where fingers overlap."""
        points = self._hand.chain_points_m(joints_rad)
        starts, lines = points[:, :, :-1], np.diff(points, axis=2)
        last = lines[:, :, -1]
        lengths = np.linalg.norm(last, axis=-1)
        lines[:, :, -1] *= ((lengths - self._tip_radii_m) / lengths)[..., None]
        # Coordinates first, which numpy multiplies three times as fast.
        starts, lines = (
            np.moveaxis(each, -1, 0).reshape(3, len(points), -1) for each in (starts, lines)
        )
        first, second = self._first, self._second
        distances_m = segment_distances_m(
            starts[:, :, first], lines[:, :, first], starts[:, :, second], lines[:, :, second]
        )
        return np.asarray((distances_m - self._both_radii_m).min(axis=-1))

    def limited(
        self, joints_rad: np.ndarray, step_rad: np.ndarray, clearance_m: float
    ) -> tuple[Float64[np.ndarray, " joints"], Bool[np.ndarray, " fingers"]]:
        """The angles after a step in which fingers stop before they are nearer than the clearance.

        Fingers that do not come near each other move on; those that are nearer from the start may
        stay or move apart. `joints_rad` [J] are finite angles before the step of `step_rad` [J]; a
        clearance of 0 lets fingers touch. Returns angles of the way, and which fingers stopped.
        """
        stops = np.ones(len(self._hand.fingers))
        if not step_rad.any():
            return joints_rad, stops < 1
        # Each turn stops one further finger at least, and a hand that stands still is admitted.
        while True:
            shares = np.minimum(SHARES[:, None], stops)[:, self._hand.finger_of_joint]
            path = joints_rad + shares * step_rad
            gaps_m = self.gaps_m(path)
            is_near = gaps_m < np.minimum(clearance_m, gaps_m[0]) - TOLERANCE_M
            if not is_near.any():
                return path[-1], stops < 1
            row = int(np.argmax(is_near.any(axis=1)))
            near = np.unique(self.pairs[is_near[row]])
            stops[near] = np.minimum(stops[near], SHARES[row - 1])


def segment_distances_m(
    p: np.ndarray, p_line: np.ndarray, q: np.ndarray, q_line: np.ndarray
) -> Float64[np.ndarray, "*batch"]:
    """Distances of the segments from p to p + p_line and from q to q + q_line, [3, ...] each.

    Ericson, Real-Time Collision Detection, section 5.1.9, for segments that are not points.
    """
    between = p - q
    pp, qq, pq = _dot(p_line, p_line), _dot(q_line, q_line), _dot(p_line, q_line)
    pb, qb = _dot(p_line, between), _dot(q_line, between)
    determinant = pp * qq - pq**2
    # Of parallel segments any point of the first will do.
    is_parallel = determinant < 1e-12 * pp * qq
    s = np.where(is_parallel, 0.0, (pq * qb - pb * qq) / np.where(is_parallel, 1.0, determinant))
    t = ((pq * s.clip(0.0, 1.0) + qb) / qq).clip(0.0, 1.0)
    s = ((pq * t - pb) / pp).clip(0.0, 1.0)
    gap = between + s * p_line - t * q_line
    return np.sqrt(_dot(gap, gap))


def _dot(a: np.ndarray, b: np.ndarray) -> Float64[np.ndarray, "*batch"]:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
