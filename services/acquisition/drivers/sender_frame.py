"""Conversion of poses from the coordinates of an SDK to our world frame."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from dextouch.errors import PacketError
from services.acquisition.drivers.sdk_link_protocol import FrameConvention
from services.acquisition.drivers.tracking import NORM_TOLERANCE, are_finite

Rows = Sequence[Sequence[float]]


class SenderFrame:
    """Turns poses of one sender into ours.

    With p_ours = M p_theirs for the world and for the body, R_ours = M R Mᵀ and t_ours = s M t.
    This holds for a left-handed sender too: both mirrors cancel in the rotation. M only renames
    axes and turns some round, so numbers are picked and signed; `pose_in_our_frame` is the plain
    form of it.

    Args:
        convention: says M.
        scale_m: s, metres of the sender's unit.
    """

    def __init__(self, convention: FrameConvention, scale_m: float) -> None:
        rows = convention.ours_from_theirs().tolist()
        # Which of the sender's axes is our x, y, z, and with which sign.
        self._places = tuple(row.index(sum(row)) for row in rows)
        self._signs = tuple(sum(row) for row in rows)
        self._scale_m = scale_m

    def pose(self, numbers: Sequence[float]) -> tuple[float, ...]:
        """Pose x y z (m) qw qx qy qz of the twelve numbers of [R | t], row by row.

        Raises:
            PacketError: not finite, or R is no rotation (by more than 1e-3).
        """
        if not are_finite(numbers):
            raise PacketError("pose matrix: NaN or infinity")
        rows = numbers[0:4], numbers[4:8], numbers[8:12]
        check_rotation(rows)
        x, y, z = self._places
        row_x, row_y, row_z = rows[x], rows[y], rows[z]
        sign_x, sign_y, sign_z = self._signs
        xy, yz, zx = sign_x * sign_y, sign_y * sign_z, sign_z * sign_x
        # Plus zero, since products of matrices give no −0, on which signs would hang.
        R_ours = (
            (row_x[x], xy * row_x[y] + 0.0, zx * row_x[z] + 0.0),
            (xy * row_y[x] + 0.0, row_y[y], yz * row_y[z] + 0.0),
            (zx * row_z[x] + 0.0, yz * row_z[y] + 0.0, row_z[z]),
        )
        scale_m = self._scale_m
        return (
            scale_m * (sign_x * row_x[3] + 0.0),
            scale_m * (sign_y * row_y[3] + 0.0),
            scale_m * (sign_z * row_z[3] + 0.0),
            *quaternion_of_one(R_ours),
        )


def pose_in_our_frame(
    matrix: Float64[np.ndarray, "3 4"],
    ours_from_theirs: Float64[np.ndarray, "3 3"],
    scale_m: float,
) -> Float64[np.ndarray, " 7"]:
    """Pose x y z (m) qw qx qy qz of a sender's matrix [R | t], by products of matrices.

    Args:
        matrix: [R | t], sender's frame and unit of length.
        ours_from_theirs: M, orthogonal, det +1 or −1.
        scale_m: s, metres of the sender's unit.

    Raises:
        PacketError: not finite, or R is no rotation (by more than 1e-3).
    """
    R = matrix[:, :3]
    if not np.all(np.isfinite(matrix)):
        raise PacketError("pose matrix: NaN or infinity")
    check_rotation(R.tolist())
    R_ours = ours_from_theirs @ R @ ours_from_theirs.T
    t_ours_m = scale_m * (ours_from_theirs @ matrix[:, 3])
    return np.array([*t_ours_m.tolist(), *quaternion_of_one(R_ours.tolist())])


def quaternion_of_one(R: Rows) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z), w ≥ 0, of one rotation matrix given as rows.

    Shepperd's method, as in `dextouch.geometry.rotations.quaternion_from_rotation`, for a single
    matrix: numpy's cost for nine numbers would be most of a packet's.
    """
    (a, b, c), (d, e, f), (g, h, i) = R
    # 4·(w², x², y², z²); the largest one is the safe divisor.
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    best = squares.index(max(squares))
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    w, x, y, z = rows[best]
    scale = math.copysign(1.0, w) / math.hypot(w, x, y, z)
    return w * scale, x * scale, y * scale, z * scale


def check_rotation(rows: Rows) -> None:
    """Refuse rows whose first three columns are no rotation.

    Raises:
        PacketError: off by more than 1e-3, or mirrored.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rows)
    error = max(
        abs(a * a + b * b + c * c - 1),
        abs(d * d + e * e + f * f - 1),
        abs(g * g + h * h + i * i - 1),
        abs(a * d + b * e + c * f),
        abs(d * g + e * h + f * i),
        abs(g * a + h * b + i * c),
    )
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if error > NORM_TOLERANCE or determinant < 0:
        raise PacketError(f"pose matrix: no rotation (R Rᵀ is off by {error:.1e})")
