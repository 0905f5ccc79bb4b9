"""Driver of a bridge that sends plain numbers, such as a Lab Streaming Layer outlet behind one."""

from typing import Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator

from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import NUM_TAXELS, Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import (
    DeviceKind,
    StreamName,
    TrackerSettings,
    tracker_transport,
)
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.packets import Packet
from services.acquisition.drivers.sdk_link import (
    MAX_CHANNELS,
    BridgedDevice,
    BridgeDecoder,
    BridgeDriver,
    BridgeHello,
)

MAGIC = b"DXNB"
_NUMBER = np.dtype("<f8")
POSE_SHAPE = (7,)
POSE_UNIT = "pose_m_wxyz"
# As for poses of trackers: what float32 and a decimal or two of text lose stays below it.
NORM_TOLERANCE = 1e-3


def _is_pose(numbers: Float64[np.ndarray, "7"]) -> bool:
    norm = float(np.linalg.norm(numbers[3:]))
    return bool(np.isfinite(numbers).all()) and abs(norm - 1.0) <= NORM_TOLERANCE


class NumbersDecoder(BridgeDecoder):
    """Samples of one declared stream, its numbers as the bridge sends them.

    NaN is kept, except in poses: one that is not finite, or whose quaternion is not of unit length,
    is counted as `refused`. The descriptor's shape says how many numbers a sample has; without a
    serial number the source is the bridge's only one.
    """

    def __init__(self, descriptor: StreamDescriptor, *, serial_number: str | None = None) -> None:
        self._num_channels = int(np.prod(descriptor.shape))
        self._descriptor = descriptor
        super().__init__(
            "numbers",
            descriptor,
            source="none",
            serial_number=serial_number,
            magic=MAGIC,
            payload_bytes=self._num_channels * _NUMBER.itemsize,
        )

    def _learn(self, hello: BridgeHello, chosen: BridgedDevice) -> None:
        if hello.channels != self._num_channels:
            raise self._error(
                f"the bridge sends {hello.channels} numbers a sample, expected "
                f"{self._num_channels} of shape {self._descriptor.shape}; correct `shape`",
                "wrong_hello",
            )

    def _new_sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        if not self.is_fresh(packet.t_device_ns, t_host_ns):
            return None
        numbers = np.frombuffer(packet.payload, _NUMBER)
        if self._descriptor.unit == POSE_UNIT and not _is_pose(numbers):
            self.statistics.refused += 1
            return None
        values = numbers.astype(self._descriptor.numpy_dtype()).reshape(self._descriptor.shape)
        return Sample(t_host_ns, values, packet.t_device_ns, packet.sequence)


class NumbersSettings(TrackerSettings):
    """A stream of numbers from a bridge, declared here because numbers do not describe themselves.

    A stream of the kind `pose` has the shape 7 and the unit `pose_m_wxyz`: x y z (m) qw qx qy qz in
    the axes of `frame`.
    """

    kind: Literal["numbers"] = "numbers"
    link: Literal["bridge"] = "bridge"
    stream: StreamName
    stream_kind: Literal["tactile", "keypoints", "pose", "robot_state", "scalar"] = "scalar"
    shape: tuple[int, ...] = Field(min_length=1, max_length=4)
    unit: str = Field(min_length=1, max_length=64)
    rate_hz: float = Field(gt=0, le=10_000)
    dtype: Literal["float32", "float64"] = "float64"
    frame: str | None = None
    side: Side | None = None

    @model_validator(mode="after")
    def _is_a_stream(self) -> "NumbersSettings":
        if not 1 <= np.prod(self.shape, dtype=float) <= MAX_CHANNELS or min(self.shape) < 1:
            raise ValueError(f"shape: got {self.shape}, expected 1 … {MAX_CHANNELS} numbers")
        if self.stream.startswith("camera_"):
            raise ValueError(f"stream: got {self.stream!r}, expected another name: cameras give it")
        is_touch = (self.stream_kind, self.unit) == ("tactile", "kPa")
        if is_touch and self.shape != (NUM_TAXELS,):
            raise ValueError(
                f"shape: got {self.shape} of a tactile stream in kPa, expected ({NUM_TAXELS},), "
                "the taxels of dextouch_v1; record another glove in its own unit as a `scalar`, "
                "or with a driver that takes a `layout`"
            )
        is_pose = (self.shape, self.unit) == (POSE_SHAPE, POSE_UNIT)
        if is_pose is not (self.stream_kind == "pose") or (is_pose and self.frame is None):
            raise ValueError(
                f"got stream_kind {self.stream_kind!r}, shape {self.shape}, unit {self.unit!r}, "
                f"frame {self.frame!r}; expected of a pose, and of nothing else, shape "
                f"{POSE_SHAPE}, unit {POSE_UNIT!r} and a frame, such as 'world'"
            )
        return self


def build(settings: NumbersSettings, clock: StationClock) -> Driver:
    """The driver of one stream."""
    name = f"numbers_{settings.stream}"
    descriptor = StreamDescriptor(
        name=settings.stream,
        kind=settings.stream_kind,
        shape=settings.shape,
        dtype=settings.dtype,
        unit=settings.unit,
        nominal_rate_hz=settings.rate_hz,
        frame=settings.frame,
        side=settings.side,
        device=name,
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )
    decoder = NumbersDecoder(descriptor, serial_number=settings.serial_number)
    transport = tracker_transport(settings)
    return BridgeDriver(name, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(name="numbers", settings=NumbersSettings, build=build)
