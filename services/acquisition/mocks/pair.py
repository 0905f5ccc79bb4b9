"""A simulated device and the real driver that reads it, side by side."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dextouch.schemas import Matrix
from services.acquisition.drivers.base import Driver
from services.acquisition.mocks.replay import MockDevice


@dataclass(frozen=True)
class MockPair:
    """A simulated device and the real driver on its other end.

    Attributes:
        device: plays the packets.
        driver: reads them.
        calibration: matrices by name that a calibrated station knows of such a device, such as
            `tactile_left_tare_counts`; none where its maker's devices come without them.
    """

    device: MockDevice
    driver: Driver
    calibration: Mapping[str, Matrix] = field(default_factory=dict)
