"""A simulated device and the real driver that reads it, side by side."""

from dataclasses import dataclass

from services.acquisition.drivers.base import Driver
from services.acquisition.mocks.replay import MockDevice


@dataclass(frozen=True)
class MockPair:
    """A simulated device and the real driver on its other end."""

    device: MockDevice
    driver: Driver
