"""Retargeting: tracked hands and wrists to the robot's joints and poses."""

from services.alignment.retargeting.hand_retargeter import (
    HandRetargeter,
    RetargetResult,
    RetargetStatus,
)

__all__ = ["HandRetargeter", "RetargetResult", "RetargetStatus"]
