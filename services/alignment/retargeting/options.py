"""Options of retargeting: weights, limits and thresholds of the solver."""

from dataclasses import astuple, dataclass, fields

import numpy as np

from dextouch.errors import InvalidInputError
from services.alignment.retargeting.hand_arrays import STARTS
from services.alignment.retargeting.solver.arrays import PINCH_WEIGHT_FAR


@dataclass(frozen=True)
class RetargetOptions:
    """Options of the solver; the defaults are what `python -m benchmarks retargeting` measures.

    Args:
        temporal_weight_m2: pull towards the sample before, m²/rad² at 60 Hz beside points of unit
            weight; at other rates in proportion to the rate. 0 follows every sample exactly.
        velocity_limit_rad_s: no joint turns faster from sample to sample.
        max_step_rad: live (`HandRetargeter.step`), largest change of a joint between two outputs,
            regardless of the elapsed time; the default is 9.6 rad/s at 60 Hz. Motors that are led
            to their targets smoothly may be given the velocity limit times the period of a slower
            tracker.
        pinch_near_m: below this distance of thumb and fingertip the vector between them has its
            full weight.
        pinch_far_m: from here on it has none, and thumb and finger are solved apart.
        pinch_weight: the full weight, beside points of unit weight.
        posture_weight_m2: pull of joints in a pinch towards what their own points ask for, m²/rad².
        reacquire_after_s: a finger that was lost for so long is searched from several starts.
        num_starts: of such a search, 1 … 8.
        keeps_fingers_apart: push neighbouring fingers apart where their capsules overlap; costs
            microseconds where they do not.
    """

    temporal_weight_m2: float = 1e-4
    velocity_limit_rad_s: float = 9.6
    max_step_rad: float = 0.16
    pinch_near_m: float = 0.005
    pinch_far_m: float = 0.060
    pinch_weight: float = 100.0
    posture_weight_m2: float = 3e-3
    reacquire_after_s: float = 0.1
    num_starts: int = len(STARTS)
    keeps_fingers_apart: bool = False

    def __post_init__(self) -> None:
        ranges = {
            "temporal_weight_m2": (0.0, MAX_WEIGHT),
            "velocity_limit_rad_s": (LEAST, np.inf),
            "max_step_rad": (LEAST, np.inf),
            "pinch_near_m": (LEAST, 1.0),
            "pinch_far_m": (self.pinch_near_m + LEAST, 1.0),
            "pinch_weight": (PINCH_WEIGHT_FAR, MAX_WEIGHT),
            "posture_weight_m2": (0.0, MAX_WEIGHT),
            "reacquire_after_s": (LEAST, np.inf),
            "num_starts": (1, len(STARTS)),
        }
        wrong = [
            f"{name} {getattr(self, name):g} (expected {low:g} … {high:g})"
            for name, (low, high) in ranges.items()
            if not low <= getattr(self, name) <= high
        ]
        if wrong:
            raise InvalidInputError(f"retargeting options: got {', '.join(wrong)}")

    def tuning(self, *, is_live: bool = False) -> np.ndarray:
        """The options as the record, shape [1], that the compiled solver reads.

        Args:
            is_live: every output is sent to motors, so no joint goes further than `max_step_rad`.
        """
        types = [(field.name, field.type) for field in fields(self)]
        return np.array([(*astuple(self), is_live)], dtype=[*types, ("is_live", bool)])


# Beyond, products of weights and distances drown what the points say.
MAX_WEIGHT = 1e6
LEAST = 1e-6
