"""Retargeting of tracked human hands and wrists to the robot's joints and poses."""

from services.alignment.retargeting.hand_retargeter import (
    HandProfile,
    HandRetargeter,
    RetargetResult,
    warm_up,
)
from services.alignment.retargeting.solver.arrays import RetargetOptions, RetargetStatus

__all__ = [
    "HandProfile",
    "HandRetargeter",
    "RetargetOptions",
    "RetargetResult",
    "RetargetStatus",
    "warm_up",
]
