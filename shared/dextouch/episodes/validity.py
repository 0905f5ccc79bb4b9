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
from dextouch.schemas import ActionKind, EpisodeAttributes, Matrix
from dextouch.tactile.layout import FINGERS, NUM_TAXELS, SIDES

JOINTS: Final = slice(JOINTS_LEFT.start, JOINTS_RIGHT.stop)
# Columns of measured and of commanded actions that come from a stream. Nobody commands the head.
COLUMNS: Final[Mapping[ActionKind, Mapping[str, slice]]] = {
    "measured": {
        "wrist_left": WRIST_LEFT,
        "wrist_right": WRIST_RIGHT,
        "head": CAMERA_HEAD,
        "keypoints_left": JOINTS_LEFT,
        "keypoints_right": JOINTS_RIGHT,
        "joints_measured": JOINTS,
    },
    "commanded": {
        "wrist_left_commanded": WRIST_LEFT,
        "wrist_right_commanded": WRIST_RIGHT,
        "head": CAMERA_HEAD,
        "joints_commanded": JOINTS,
    },
}
_PARTS: Final = tuple(dict.fromkeys(part for kind in COLUMNS.values() for part in kind))
_JOINTS_OF_FINGER: Final = (JOINTS_LEFT.stop - JOINTS_LEFT.start) // len(FINGERS)


def columns_of(parts: tuple[str, ...], kind: ActionKind = "measured") -> Bool[np.ndarray, "67"]:
    """Columns of actions that belong to some parts: streams, or fingers such as `thumb_left`."""
    found = np.zeros(ACTION_DIM, dtype=np.bool_)
    for part in parts:
        finger, _, side = part.partition("_")
        if part in COLUMNS[kind]:
            found[COLUMNS[kind][part]] = True
        elif kind == "measured" and finger in FINGERS and side in SIDES:
            first = COLUMNS[kind][f"keypoints_{side}"].start + _JOINTS_OF_FINGER * FINGERS.index(
                finger
            )
            found[first : first + _JOINTS_OF_FINGER] = True
    return found


def interpolated_spans(calibration: Mapping[str, Matrix]) -> list[tuple[str, int, int]]:
    """Parts of the action that were interpolated, from when and until when (ns), in order of time.

    A part is a stream, or a finger such as `thumb_left`.
    """
    spans = [
        (stream, start_s, stop_s)
        for stream in _PARTS
        for start_s, stop_s in calibration.get(f"interpolated_{stream}_s", ())
    ]
    spans += [
        (f"{FINGERS[int(finger)]}_{side}", start_s, stop_s)
        for side in SIDES
        for start_s, stop_s, finger in calibration.get(f"interpolated_fingers_{side}_s", ())
    ]
    found = [(part, round(start_s * 1e9), round(stop_s * 1e9)) for part, start_s, stop_s in spans]
    return sorted(found, key=lambda span: span[1:])


def interpolated_actions(
    calibration: Mapping[str, Matrix],
    t_ref_ns: Int64[np.ndarray, " steps"],
    kind: ActionKind = "measured",
) -> Bool[np.ndarray, "steps 67"]:
    """Columns of measured or commanded actions that were interpolated, by step."""
    found = np.zeros((len(t_ref_ns), ACTION_DIM), dtype=np.bool_)
    for part, start_ns, stop_ns in interpolated_spans(calibration):
        # Seconds in floats may be a nanosecond off the stamps.
        inside = (t_ref_ns >= start_ns - 1) & (t_ref_ns < stop_ns - 1)
        found[np.ix_(inside, columns_of((part,), kind))] = True
    return found


def measured_actions(
    about: EpisodeAttributes, t_ref_ns: Int64[np.ndarray, " steps"], kind: ActionKind = "measured"
) -> Bool[np.ndarray, "steps 67"]:
    """Columns of actions that were measured (or commanded), neither interpolated nor absent."""
    return ~(
        interpolated_actions(about.calibration, t_ref_ns, kind) | columns_of(about.absent, kind)
    )


def measured_taxels(
    calibration: Mapping[str, Matrix], num_taxels: int = NUM_TAXELS
) -> Bool[np.ndarray, "2 taxels"]:
    """Taxels that alignment did not refuse; the others are zero throughout."""
    refused = [calibration.get(f"tactile_{side}_refused_taxels", 0.0) for side in SIDES]
    return np.stack([np.broadcast_to(np.ravel(one) == 0, num_taxels) for one in refused])
