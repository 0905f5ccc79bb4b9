"""Which values of an episode were measured: parts of actions by step, and taxels.

Alignment writes what was not as matrices beside the episode's calibration (docs/alignment.md):
`interpolated_<stream>_s`, rows of start and stop (s, on the episode's clock), in which a stream is
missing; `interpolated_fingers_<side>_s`, rows of start, stop and finger (0 the thumb); and
`tactile_<side>_refused_taxels`. Parts that no step has are in the attribute `absent`.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
from jaxtyping import Bool, Int64

from dextouch.hands.actions import (
    ACTION_DIM,
    CAMERA_HEAD,
    JOINTS_LEFT,
    JOINTS_RIGHT,
    WRIST_LEFT,
    WRIST_RIGHT,
)
from dextouch.schemas import EpisodeAttributes, Matrix
from dextouch.tactile.layout import FINGERS, NUM_TAXELS, SIDES

JOINTS: Final = slice(JOINTS_LEFT.start, JOINTS_RIGHT.stop)
# Columns of actions that come from a stream; a commanded one has those of its measured one.
COLUMNS: Final[Mapping[str, slice]] = {
    "wrist_left": WRIST_LEFT,
    "wrist_right": WRIST_RIGHT,
    "head": CAMERA_HEAD,
    "keypoints_left": JOINTS_LEFT,
    "keypoints_right": JOINTS_RIGHT,
    "joints_measured": JOINTS,
    "wrist_left_commanded": WRIST_LEFT,
    "wrist_right_commanded": WRIST_RIGHT,
    "joints_commanded": JOINTS,
}
_JOINTS_OF_FINGER: Final = (JOINTS_LEFT.stop - JOINTS_LEFT.start) // len(FINGERS)


def finger_columns(side: str, finger: int) -> slice:
    """Columns of the joints of a finger, 0 the thumb."""
    first = COLUMNS[f"keypoints_{side}"].start + _JOINTS_OF_FINGER * finger
    return slice(first, first + _JOINTS_OF_FINGER)


def absent_columns(absent: tuple[str, ...]) -> Bool[np.ndarray, "67"]:
    """Columns of actions that no step has: parts are streams, or fingers such as `thumb_left`."""
    found = np.zeros(ACTION_DIM, dtype=np.bool_)
    for part in absent:
        finger, _, side = part.partition("_")
        if part in COLUMNS:
            found[COLUMNS[part]] = True
        elif finger in FINGERS and side in SIDES:
            found[finger_columns(side, FINGERS.index(finger))] = True
    return found


def interpolated_actions(
    calibration: Mapping[str, Matrix], t_ref_ns: Int64[np.ndarray, " steps"]
) -> Bool[np.ndarray, "steps 67"]:
    """Columns of actions that were interpolated, by step."""
    found = np.zeros((len(t_ref_ns), ACTION_DIM), dtype=np.bool_)

    def inside(start_s: float, stop_s: float) -> Bool[np.ndarray, " steps"]:
        # Stamps are whole nanoseconds, and so far these seconds may be off them.
        return (t_ref_ns >= start_s * 1e9 - 1) & (t_ref_ns < stop_s * 1e9 - 1)

    for stream, columns in COLUMNS.items():
        for start_s, stop_s in calibration.get(f"interpolated_{stream}_s", ()):
            found[inside(start_s, stop_s), columns] = True
    for side in SIDES:
        for start_s, stop_s, finger in calibration.get(f"interpolated_fingers_{side}_s", ()):
            found[inside(start_s, stop_s), finger_columns(side, int(finger))] = True
    return found


def measured_actions(
    about: EpisodeAttributes, t_ref_ns: Int64[np.ndarray, " steps"]
) -> Bool[np.ndarray, "steps 67"]:
    """Columns of actions that were measured (or commanded), neither interpolated nor absent."""
    return ~(interpolated_actions(about.calibration, t_ref_ns) | absent_columns(about.absent))


def measured_taxels(calibration: Mapping[str, Matrix]) -> Bool[np.ndarray, "2 320"]:
    """Taxels that alignment did not refuse; the others are zero throughout."""
    refused = [calibration.get(f"tactile_{side}_refused_taxels", 0.0) for side in SIDES]
    return np.stack([np.broadcast_to(np.ravel(one) == 0, NUM_TAXELS) for one in refused])
