"""Lossless codec between samples of a stream and their MCAP message."""

from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Shaped

from dextouch.bridges.mcap.protobuf import Values, decode, encode
from dextouch.bridges.mcap.schemas import (
    CALIBRATION,
    COMPRESSED_IMAGE,
    COMPRESSED_VIDEO,
    FRAME_TRANSFORM,
    POSES_IN_FRAME,
    RAW_IMAGE,
    SEQUENCE,
    T_DEVICE,
    TABLE,
    frame_of,
    message_of,
    num_elements,
    parent_of,
    raw_encoding,
)
from dextouch.errors import CorruptDataError
from dextouch.streams import StreamDescriptor

_NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class Sent:
    """Content of a message: time stamp, device stamp and counter if any, and value."""

    t_ns: int
    t_device_ns: int
    sequence: int
    value: Shaped[np.ndarray, "..."] | bytes


def timestamp(t_ns: int) -> Values:
    """A protobuf Timestamp; negative times have negative seconds and positive nanoseconds."""
    seconds, nanos = divmod(t_ns, _NS_PER_S)
    return {"seconds": seconds, "nanos": nanos}


class MessageCodec:
    """Encodes and decodes the samples of one stream.

    Args:
        descriptor: of the stream.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self.descriptor, self.message = descriptor, message_of(descriptor)
        self._num_elements = num_elements(descriptor)
        self._constant = self._constants()

    def _constants(self) -> Values:
        descriptor, message = self.descriptor, self.message
        frame = frame_of(descriptor)
        if message == FRAME_TRANSFORM:
            return {"parent_frame_id": parent_of(descriptor), "child_frame_id": frame}
        if message == POSES_IN_FRAME:
            return {"frame_id": parent_of(descriptor)}
        if message in {COMPRESSED_IMAGE, COMPRESSED_VIDEO}:
            return {"frame_id": frame, "format": descriptor.unit}
        if message == RAW_IMAGE:
            height_px, width_px = descriptor.shape[:2]
            return {
                "frame_id": frame,
                "width": width_px,
                "height": height_px,
                "encoding": raw_encoding(descriptor),
                "step": self._num_bytes() // height_px if height_px else 0,
            }
        return {"frame_id": frame, "shape": np.array(descriptor.shape, dtype=np.uint32)}

    def _num_bytes(self) -> int:
        return self._num_elements * self.descriptor.numpy_dtype().itemsize

    def encode(self, sent: Sent, *, with_device: bool) -> bytes:
        """Bytes of one message; `with_device` keeps the device's stamp and counter (recordings)."""
        values: Values = {"timestamp": timestamp(sent.t_ns), **self._constant}
        if with_device:
            values |= {T_DEVICE: sent.t_device_ns, SEQUENCE: sent.sequence}
        value = sent.value
        if isinstance(value, bytes):
            values["data"] = value
        elif self.message == RAW_IMAGE:
            values["data"] = value.tobytes()
        elif self.message == FRAME_TRANSFORM:
            values["translation"], values["rotation"] = _pose_parts(value)
        elif self.message == POSES_IN_FRAME:
            parts = [_pose_parts(pose) for pose in value]
            values["poses"] = [{"position": t, "orientation": q} for t, q in parts]
        else:
            values["values"] = value
        return encode(TABLE, self.message, values)

    def decode(self, data: bytes) -> Sent:
        """Decode a message; a missing device field becomes 0.

        Raises:
            CorruptDataError: bytes that are not a message of this stream.
        """
        values = decode(TABLE, self.message, data)
        try:
            return Sent(
                t_ns=_nanoseconds(values),
                t_device_ns=cast(int, values.get(T_DEVICE, 0)),
                sequence=cast(int, values.get(SEQUENCE, 0)),
                value=self._value(values),
            )
        except KeyError as error:
            raise CorruptDataError(
                f"{self.descriptor.name}: a {self.message} has no field {error}"
            ) from error

    def _value(self, values: Values) -> np.ndarray | bytes:
        descriptor = self.descriptor
        if self.message in {COMPRESSED_IMAGE, COMPRESSED_VIDEO}:
            if values.get("format") != descriptor.unit:
                raise CorruptDataError(
                    f"{descriptor.name}: got format {values.get('format')!r}, "
                    f"expected {descriptor.unit!r}"
                )
            return cast(bytes, values["data"])
        if self.message == FRAME_TRANSFORM:
            row = _pose_row(values["translation"], values["rotation"])
        elif self.message == POSES_IN_FRAME:
            poses = cast(list[Values], values.get("poses", []))
            row = [x for pose in poses for x in _pose_row(pose["position"], pose["orientation"])]
        elif self.message == RAW_IMAGE:
            return self._shaped(self._pixels(cast(bytes, values["data"])))
        else:
            return self._shaped(self._array(cast(np.ndarray, values.get("values", np.empty(0)))))
        return self._shaped(np.array(row, dtype=np.float64))

    def _pixels(self, data: bytes) -> np.ndarray:
        if len(data) != self._num_bytes():
            raise CorruptDataError(
                f"{self.descriptor.name}: got an image of {len(data)} bytes, "
                f"expected {self._num_bytes()}"
            )
        return np.frombuffer(data, dtype=self.descriptor.numpy_dtype())

    def _array(self, array: np.ndarray) -> np.ndarray:
        dtype = self.descriptor.numpy_dtype()
        if dtype.kind == "u" and array.size and int(array.max()) >> (8 * dtype.itemsize):
            raise CorruptDataError(
                f"{self.descriptor.name}: got {int(array.max())}, expected numbers of {dtype}"
            )
        return array.astype(dtype)

    def _shaped(self, flat: np.ndarray) -> np.ndarray:
        if flat.size != self._num_elements:
            raise CorruptDataError(
                f"{self.descriptor.name}: got a sample of {flat.size} numbers, "
                f"expected {self.descriptor.shape}"
            )
        return flat.reshape(self.descriptor.shape)


def _pose_parts(pose: np.ndarray) -> tuple[Values, Values]:
    x, y, z, qw, qx, qy, qz = (float(value) for value in pose)
    return {"x": x, "y": y, "z": z}, {"x": qx, "y": qy, "z": qz, "w": qw}


def _pose_row(translation: object, rotation: object) -> list[float]:
    # A writer may leave zeros out: that is proto3's default.
    t, q = cast(dict[str, float], translation), cast(dict[str, float], rotation)
    return [t.get(axis, 0.0) for axis in "xyz"] + [q.get(axis, 0.0) for axis in "wxyz"]


def _nanoseconds(values: Values) -> int:
    stamp = cast(dict[str, int], values["timestamp"])
    return stamp.get("seconds", 0) * _NS_PER_S + stamp.get("nanos", 0)


def calibration_message(
    K: np.ndarray, distortion: np.ndarray, *, t_ns: int, frame: str, shape_px: tuple[int, int]
) -> bytes:
    """A foxglove.CameraCalibration for unrectified images.

    Args:
        K: camera matrix in pixels, 3×3.
        distortion: k1 k2 p1 p2 k3; zeros for a pinhole.
        t_ns: start of its validity.
        frame: of the camera.
        shape_px: height and width of its images.
    """
    K = np.asarray(K, dtype=np.float64)
    return encode(
        TABLE,
        CALIBRATION,
        {
            "timestamp": timestamp(t_ns),
            "frame_id": frame,
            "height": shape_px[0],
            "width": shape_px[1],
            "distortion_model": "plumb_bob",
            "D": np.asarray(distortion, dtype=np.float64),
            "K": K.ravel(),
            "R": np.eye(3).ravel(),
            "P": np.hstack([K, np.zeros((3, 1))]).ravel(),
        },
    )
