"""Settings of teleoperation: rate of the commands, limits of the joints, watchdog, calibration."""

from pathlib import Path

from pydantic import Field, model_validator

from dextouch.frozen_model import FrozenModel
from dextouch.serving import ServiceSettings, service_config


class CommandLimits(FrozenModel):
    """What commands keep, and when the watchdog acts."""

    speed_rad_s: float = Field(
        default=9.6,
        gt=0,
        le=50,
        description="largest speed of a joint; the Wuji Hand 2 reaches about 9.6",
    )
    relax_speed_rad_s: float = Field(
        default=0.5, gt=0, le=50, description="speed of joints on the way to the relaxed pose"
    )
    margin_rad: float = Field(
        default=0.0, ge=0, le=0.3, description="distance that joints keep from their limits"
    )
    clearance_m: float = Field(
        default=0.0,
        ge=0,
        le=0.02,
        description="smallest gap between two fingers; 0 lets them touch, as pinches need",
    )
    hold_after_s: float = Field(
        default=0.1, gt=0, description="age of the last sample from which on the hand holds still"
    )
    relax_after_s: float = Field(
        default=5.0, gt=0, description="age from which on it moves to the relaxed pose"
    )

    @model_validator(mode="after")
    def _holds_before_it_relaxes(self) -> "CommandLimits":
        if self.relax_after_s < self.hold_after_s:
            raise ValueError(
                f"relax_after_s: got {self.relax_after_s}, expected at least hold_after_s "
                f"({self.hold_after_s})"
            )
        return self


class TeleoperationSettings(ServiceSettings):
    """Serve commands for the joints of a robot hand that follows a tracked hand live.

    A controller sends the keypoints of a hand to the WebSocket /v1/teleop/left or
    /v1/teleop/right, and gets joint angles at a fixed rate, within limits of position and speed
    and without fingers that run into each other. See docs/teleoperation.md, also for what it does
    not guarantee.

    Example:
      dextouch teleop serve --port 8088 --calibration calibration/calibration.json
    """

    model_config = service_config("teleoperation", "dextouch teleop serve")

    # A sample waits 5 ms at most for its command; the other 5 of 10 ms are for a busy machine.
    rate_hz: float = Field(default=200.0, ge=10, le=1000, description="commands a second")
    limits: CommandLimits = Field(
        default=CommandLimits(), description="limits of the commands, and the watchdog"
    )
    calibration: Path | None = Field(
        default=None,
        description="file with the wrist axes and hand profile of a person (dextouch station "
        "calibrate wrist and profile); without it, samples are in wrist axes, and bones are "
        "measured from the first ones",
    )
