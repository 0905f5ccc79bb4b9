"""Profile of a person's hand: bone lengths and knuckle positions, which no motion changes.

Tracked points wobble by millimetres; bones do not. Bone lengths and the places of the knuckles in
the wrist frame are therefore measured once a person, from calibration samples or from a whole
recording, and later samples are checked against them and solved with them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands import CHAINS

NUM_FINGERS = 5
# Proximal phalanx of an index finger, children to large adults and robots: outside, the unit is
# wrong.
INDEX_PROXIMAL_RANGE_M = (0.025, 0.060)
BONE_RANGE_M = (0.003, 0.150)
_INDEX_FINGER = CHAINS.index("index")
NUM_COLUMNS = 9
# A person's knuckles turn in place (0), the robot's travel with its flexion axes (1).
RIGID_TRAVEL = 0.5


@dataclass(frozen=True)
class HandProfile:
    """Constant geometry of one person's hand, thumb … little, in wrist axes.

    Attributes:
        bone_m: MCP–PIP, PIP–DIP, DIP–tip (of the thumb CMC–MCP, MCP–IP, IP–tip).
        knuckle_m: the MCP (of the thumb: the CMC) in the wrist frame.
        travel: how much of the travel that the robot's knuckle makes with flexion the tracked one
            makes: 0 for people, whose knuckles turn in place, 1 for the robot hand itself.
        knuckle_sigma_m: standard deviation per axis of a knuckle's residual motion.
        point_sigma_m: standard deviation, an axis, of the tracker's noise.
    """

    bone_m: Float64[np.ndarray, "5 3"]
    knuckle_m: Float64[np.ndarray, "5 3"]
    travel: Float64[np.ndarray, "5"]
    knuckle_sigma_m: Float64[np.ndarray, "5"]
    point_sigma_m: float

    def __post_init__(self) -> None:
        rows = self.to_rows()
        if not np.isfinite(rows).all() or (rows[:, 7:] < 0).any():
            raise InvalidInputError("hand profile: expected finite numbers, no negative sigma")
        check_bone_unit(float(self.bone_m[_INDEX_FINGER, 0]), where="hand profile")
        low, high = BONE_RANGE_M
        if not ((self.bone_m >= low) & (self.bone_m <= high)).all():
            raise InvalidInputError(
                f"hand profile: bones {np.round(self.bone_m, 4).tolist()}, "
                f"expected {low} … {high} m"
            )

    @property
    def is_rigid(self) -> bool:
        """Whether this is the robot's own hand (or a copy), with exact bones and knuckles.

        People's tracked bones and knuckles shift by millimetres with the posture; to hold them
        fixed would bend fingers that are straight.
        """
        return bool(np.median(self.travel) >= RIGID_TRAVEL)

    def to_rows(self) -> Float64[np.ndarray, "5 9"]:
        """As a matrix for a recording's calibration.

        Columns: 3 bones (m), 3 knuckle coordinates (m), travel, knuckle sigma (m), the tracker's
        noise (m; the same in every row).
        """
        noise_m = np.full(NUM_FINGERS, self.point_sigma_m)
        columns = self.bone_m, self.knuckle_m, self.travel, self.knuckle_sigma_m, noise_m
        return np.column_stack(columns).astype(np.float64)

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[float]]) -> "HandProfile":
        """From the matrix of `to_rows`.

        Raises:
            ShapeError: not [5, 9].
            InvalidInputError: not finite, or not a valid hand.
        """
        table = np.asarray(rows, dtype=np.float64)
        if table.shape != (NUM_FINGERS, NUM_COLUMNS):
            raise ShapeError(f"hand profile: got shape {table.shape}, expected [5, {NUM_COLUMNS}]")
        return cls(table[:, :3], table[:, 3:6], table[:, 6], table[:, 7], float(table[0, 8]))


def profile_name(side: str) -> str:
    """Name of the matrix in a recording's calibration."""
    return f"hand_profile_{side}"


def calibrated_profile(
    calibration: Mapping[str, Sequence[Sequence[float]]], side: str
) -> HandProfile | None:
    """The hand profile of a recording's calibration; None if it has none.

    Raises:
        ShapeError, InvalidInputError: it is not a valid hand.
    """
    rows = calibration.get(profile_name(side))
    return None if rows is None else HandProfile.from_rows(rows)


def check_bone_unit(index_proximal_m: float, *, where: str) -> None:
    """Refuse an index finger's proximal bone that is not 25–60 mm long.

    Raises:
        InvalidInputError: most likely millimetres, or nodes in another order.
    """
    low, high = INDEX_PROXIMAL_RANGE_M
    if not low <= index_proximal_m <= high:
        looks = low * 1e3 <= index_proximal_m <= high * 1e3
        hint = "these look like millimetres" if looks else "check nodes"
        raise InvalidInputError(
            f"{where}: the index finger's proximal bone measures {index_proximal_m:.4g}, expected "
            f"{low} … {high} m ({hint}); send metres in the order of dextouch.hands.NODES",
            got=index_proximal_m,
        )
