"""Starts of rollouts as every world of this service takes them: from one observed step."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, UnknownNameError
from dextouch.hands.actions import AnchorPoses
from dextouch.worlds.world import Observation, RolloutStart

CAMERA: Final = "camera_head"


def complete_start(
    start: RolloutStart,
) -> tuple[Observation, AnchorPoses, Float64[np.ndarray, "3 3"]]:
    """The observation of a start, the poses it refers to, and the head camera's matrix.

    Raises:
        InvalidInputError: no observation, anchor or K_head.
        UnknownNameError: no image of the head camera.
        ShapeError: more than one observed step.
        NonFiniteError: NaN or infinity in touch.
    """
    if start.observation is None or start.anchor is None or start.K_head is None:
        raise InvalidInputError(
            "start: this world begins from an observation; send one step of images, touch and "
            "reached action together with the anchor poses and K_head"
        )
    if CAMERA not in start.observation.images:
        raise UnknownNameError("camera of the start", "none of them", [CAMERA])
    if len(start.observation) != 1:
        raise ShapeError(f"start: got {len(start.observation)} observed steps, expected one")
    if not np.isfinite(start.observation.tactile_kpa).all():
        raise NonFiniteError("start: touch holds NaN or infinity; mend or mask the sensor first")
    return start.observation, start.anchor, start.K_head
