"""Interface between a bridge and the SDK that it reads, and the readings that pass through it."""

import ctypes
import sys
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float
from pydantic import ValidationError

from dextouch.errors import InvalidInputError, UnavailableError
from dextouch.geometry.rotations import rotation_from_quaternion
from dextouch.schemas import first_problems
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.finger_tracker import VALIDITY
from services.acquisition.devices.pose_tracker import POSE_PAYLOAD, TrackingResult
from services.acquisition.drivers.packets import SOURCES
from services.acquisition.drivers.sdk_link import (
    MAX_SOFTWARE,
    PROTOCOL,
    PROTOCOL_VERSION,
    BridgedDevice,
    BridgeHello,
    FrameConvention,
)

# Two clocks are read together in a few µs; where it took longer, the process was interrupted.
# Chosen: ten attempts, since even a busy machine interrupts fewer than one of two.
READ_GAP_NS = 20_000
CLOCK_READS = 10
# Result and argument types of a shared library's functions, by their names.
Functions = Mapping[str, tuple[object, tuple[object, ...]]]
# Sources whose axes are ours already: right-handed, z up.
OUR_AXES = FrameConvention(handedness="right", axes=("+x", "+y", "+z"))
# OpenVR and OpenXR: right-handed, +x right, +y up, −z forward.
Y_UP_AXES = FrameConvention(handedness="right", axes=("+x", "+z", "-y"))


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of one device, as the payload of its packet.

    Attributes:
        device: who read it; the name tells the clocks of several devices apart.
        place: its place by its number in packets.
        t_device_ns: when it was taken, on the source's clock.
        payload: of the packet.
    """

    device: str
    place: int
    t_device_ns: int
    payload: bytes


class Source(ABC):
    """One SDK: opened, read, and opened again after it was lost.

    Attributes:
        clock: which clock stamps its readings, and how exactly, as one line for people.
        has_station_time: whether the stamps are on the clock of a station on this host.
        not_sent: how many readings became no packet, by the reason.
    """

    clock: str
    has_station_time = True

    def __init__(self) -> None:
        self.not_sent: Counter[str] = Counter()

    @abstractmethod
    def open(self) -> BridgeHello:
        """Connect to the SDK and say which devices there are.

        Raises:
            DeviceError: it does not run, or a device is not there; worth another try.
            UnavailableError: its library is not installed.
        """

    @abstractmethod
    def read(self) -> Sequence[Reading]:
        """New readings; waits for at most some hundredths of a second.

        Raises:
            DeviceError: the SDK is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect; nothing if it is not open."""

    def present(self) -> list[str]:
        """What could be served, for people; nothing where the SDK has no names to choose from."""
        return []

    def report(self) -> list[str]:
        """Further lines for the summary."""
        return []


def import_sdk(module: str, *, install: str) -> ModuleType:
    """The Python module of an SDK; `install` says what to do where it is missing.

    Raises:
        UnavailableError: it, or the shared library that it needs, is not installed.
    """
    try:
        return import_module(module)
    except (ImportError, OSError, RuntimeError) as error:
        raise UnavailableError(
            f"the Python module {module!r} cannot be imported ({error}); {install}"
        ) from error


def structure(name: str, **fields: object) -> type[ctypes.Structure]:
    """The C structure of these fields, in their order."""
    return type(name, (ctypes.Structure,), {"_fields_": tuple(fields.items())})


def load_library(path: str, functions: Functions, *, install: str) -> ctypes.CDLL:
    """A shared library, by name or path, with the types of the used functions set.

    Raises:
        UnavailableError: it is not there, or lacks a function.
    """
    try:
        library = ctypes.CDLL(path)
        for name, (result, arguments) in functions.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise UnavailableError(f"cannot load {path!r} ({error}); {install}") from error
    return library


def hello(**about: object) -> BridgeHello:
    """The first line of the connections of a bridge: `BridgeHello` without the protocol.

    A name of the software that is too long is cut.

    Raises:
        InvalidInputError: something else is outside of its limits, such as a device's name.
    """
    about["software"] = str(about["software"])[:MAX_SOFTWARE]
    fixed = {"protocol": PROTOCOL, "version": PROTOCOL_VERSION, "length_unit": "m"}
    try:
        return BridgeHello.model_validate({**fixed, **about})
    except ValidationError as error:
        raise InvalidInputError(f"bridge: {first_problems(error)}") from error


def placed_devices(places: Mapping[str, str]) -> dict[str, BridgedDevice]:
    """Devices by their serial numbers, from where each sits.

    Raises:
        InvalidInputError: a serial number or a place that is none.
    """
    try:
        return {
            serial: BridgedDevice.model_validate(
                {"index": index, "serial_number": serial, "source": place}
            )
            for index, (serial, place) in enumerate(places.items())
        }
    except ValidationError as error:
        raise InvalidInputError(f"--device: {first_problems(error)}") from error


def pose_reading(
    device: BridgedDevice,
    t_device_ns: int,
    numbers: Sequence[float],
    *,
    result: int = TrackingResult.RUNNING_OK,
    is_valid: bool = True,
) -> Reading:
    """A reading of a pose tracker.

    Args:
        device: of the hello.
        t_device_ns: when the pose was taken.
        numbers: the twelve of [R | t], row by row, in the axes and unit of the hello.
        result: of the tracking, in OpenVR's numbers; only RUNNING_OK is used by stations.
        is_valid: what the SDK says of the pose.
    """
    payload = POSE_PAYLOAD.pack(device.index, is_valid, result, t_device_ns / 1e9, *numbers)
    return Reading(device.serial_number, SOURCES[device.source], t_device_ns, payload)


def hand_reading(
    device: BridgedDevice,
    t_device_ns: int,
    points: Float[np.ndarray, "25 3"],
    is_tracked: Bool[np.ndarray, "25"],
) -> Reading:
    """A reading of a finger tracker.

    Args:
        device: of the hello.
        t_device_ns: when the hand was seen.
        points: nodes in the order of the hello, relative to the wrist node and in its axes.
        is_tracked: which of them are measured; all others become NaN in a recording.
    """
    bits = sum(1 << int(node) for node in np.flatnonzero(is_tracked))
    payload = VALIDITY.pack(bits) + points.astype("<f4").tobytes()
    return Reading(device.serial_number, SOURCES[device.source], t_device_ns, payload)


def wrist_axes(
    points: Float[np.ndarray, "n 3"],
    wrist: Float[np.ndarray, "3"],
    q_wxyz: Float[np.ndarray, "4"],
) -> Float[np.ndarray, "n 3"]:
    """Points relative to the wrist, in its axes: R⁻¹ (p − wrist), with R the wrist's rotation."""
    R = rotation_from_quaternion(np.asarray(q_wxyz, dtype=np.float64))
    return (np.asarray(points, dtype=np.float64) - wrist) @ R


def hand_device(index: int, side: Side, sdk: str) -> BridgedDevice:
    """The device of one hand."""
    return BridgedDevice(index=index, serial_number=f"{sdk}-{side}", source=side)


class Pace:
    """Waits for the next of evenly spaced moments, and leaves out those that have passed."""

    def __init__(self, rate_hz: float, clock: StationClock) -> None:
        self._period_ns = round(1e9 / rate_hz)
        self._clock = clock
        self._due_ns = clock.now_ns()

    def wait(self) -> None:
        """Sleep until the next moment."""
        now_ns = self._clock.now_ns()
        missed = max(0, (now_ns - self._due_ns) // self._period_ns)
        self._due_ns += (missed + 1) * self._period_ns
        time.sleep((self._due_ns - now_ns) / 1e9)


def station_offset_ns(clock: StationClock) -> int:
    """What a recent stamp on CLOCK_MONOTONIC of this host needs to be on the station's clock.

    NTP slews CLOCK_MONOTONIC against the station's clock, by 500 ppm (the kernel) or more (chrony),
    so it is read anew for every few stamps: for one of a tenth of a second ago 500 ppm are 50 µs.
    A reading that was interrupted is repeated; what remains is below half of READ_GAP_NS.
    """
    gap_ns, offset_ns = sys.maxsize, 0
    for _ in range(CLOCK_READS):
        before_ns = clock.now_ns()
        monotonic_ns = clock.read_ns(time.CLOCK_MONOTONIC)
        after_ns = clock.now_ns()
        if after_ns - before_ns < gap_ns:
            gap_ns = after_ns - before_ns
            offset_ns = (before_ns + after_ns) // 2 - monotonic_ns
        if gap_ns <= READ_GAP_NS:
            break
    return offset_ns
