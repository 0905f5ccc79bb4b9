"""Lossless codec between samples of a stream and their MCAP message."""

from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Shaped

from dextouch.bridges.mcap.schemas import (
    ARRAYS,
    CALIBRATION,
    COMPRESSED_IMAGE,
    COMPRESSED_VIDEO,
    FRAME_TRANSFORM,
    PACKED_ARRAY,
    POSES_IN_FRAME,
    RAW_IMAGE,
    frame_of,
    message_of,
    new_message,
    num_elements,
    parent_of,
    raw_encoding,
)
from dextouch.errors import CorruptDataError
from dextouch.streams import StreamDescriptor

_NS_PER_S: Final = 1_000_000_000
# Elements take at most 11 bytes (a coordinate of a pose), everything else of a message far less.
_MAX_BYTES_PER_ELEMENT: Final = 16
_MAX_OTHER_BYTES: Final = 1 << 16


@dataclass(frozen=True)
class Sent:
    """Content of a message: time stamp, device stamp and counter if any, and value."""

    t_ns: int
    t_device_ns: int
    sequence: int
    value: Shaped[np.ndarray, "..."] | bytes


class MessageCodec:
    """Encodes and decodes the samples of one stream.

    Args:
        descriptor: of the stream.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self.descriptor, self.message = descriptor, message_of(descriptor)
        self._num_elements = num_elements(descriptor)
        self._is_encoded = self.message in {COMPRESSED_IMAGE, COMPRESSED_VIDEO}
        self._is_array = self.message.startswith("dextouch.")
        # Each sample overwrites the fields that change.
        self._sent = self._constant()

    def _empty(self) -> Any:  # noqa: ANN401 - protobuf makes its fields at run time
        return new_message(PACKED_ARRAY if self._is_array else self.message)

    def _constant(self) -> Any:  # noqa: ANN401
        descriptor, sent = self.descriptor, self._empty()
        if self.message == FRAME_TRANSFORM:
            sent.parent_frame_id = parent_of(descriptor)
            sent.child_frame_id = frame_of(descriptor)
        elif self.message == POSES_IN_FRAME:
            sent.frame_id = parent_of(descriptor)
        else:
            sent.frame_id = frame_of(descriptor)
        if self._is_encoded:
            sent.format = descriptor.unit
        elif self.message == RAW_IMAGE:
            sent.height, sent.width = descriptor.shape[:2]
            sent.encoding = raw_encoding(descriptor)
            sent.step = self._num_bytes() // sent.height if sent.height else 0
        elif self._is_array:
            sent.shape.extend(descriptor.shape)
        return sent

    def _num_bytes(self) -> int:
        return self._num_elements * self.descriptor.numpy_dtype().itemsize

    def encode(self, sent: Sent, *, with_device: bool) -> bytes:
        """Bytes of one message; `with_device` keeps the device's stamp and counter (recordings)."""
        message, value = self._sent, sent.value
        _set_time(message.timestamp, sent.t_ns)
        if with_device:
            message.dextouch_t_device_ns = sent.t_device_ns
            message.dextouch_sequence = sent.sequence
        if isinstance(value, bytes):
            message.data = value
        elif self.message == RAW_IMAGE:
            message.data = value.tobytes()
        elif self.message == FRAME_TRANSFORM:
            _set_pose(message.translation, message.rotation, value)
        elif self.message == POSES_IN_FRAME:
            del message.poses[:]
            for row in value:
                pose = message.poses.add()
                _set_pose(pose.position, pose.orientation, row)
        else:
            message.values = value.astype(self._wire_dtype()).tobytes()
        return cast(bytes, message.SerializeToString())

    def _wire_dtype(self) -> np.dtype[Any]:
        return np.dtype(ARRAYS[self.descriptor.dtype][2])

    def decode(self, data: bytes) -> Sent:
        """Decode a message; a missing device field becomes 0.

        Raises:
            CorruptDataError: bytes that are not a message of this stream.
        """
        most_bytes = self._num_elements * _MAX_BYTES_PER_ELEMENT + _MAX_OTHER_BYTES
        if len(data) > most_bytes and not self._is_encoded:
            raise CorruptDataError(
                f"{self.descriptor.name}: got a {self.message} of {len(data)} bytes, expected at "
                f"most {most_bytes} for a sample of shape {self.descriptor.shape}"
            )
        message = self._empty()
        try:
            message.MergeFromString(data)
        except DecodeError as error:
            raise CorruptDataError(
                f"{self.descriptor.name}: got {len(data)} bytes that are not a {self.message} "
                f"({error})"
            ) from error
        t = self._part(message, "timestamp")
        return Sent(
            t_ns=t.seconds * _NS_PER_S + t.nanos,
            t_device_ns=message.dextouch_t_device_ns,
            sequence=message.dextouch_sequence,
            value=self._value(message),
        )

    def _part(self, message: Any, name: str) -> Any:  # noqa: ANN401
        if not message.HasField(name):
            raise CorruptDataError(
                f"{self.descriptor.name}: a {self.message} has no field {name!r}"
            )
        return getattr(message, name)

    def _value(self, message: Any) -> np.ndarray | bytes:  # noqa: ANN401
        if self._is_encoded:
            return self._image(message)
        if self.message == RAW_IMAGE:
            return self._array(message.data, self.descriptor.numpy_dtype())
        if self._is_array:
            return self._array(message.values, self._wire_dtype())
        if self.message == FRAME_TRANSFORM:
            row = self._pose(message, "translation", "rotation")
        else:
            poses = (self._pose(pose, "position", "orientation") for pose in message.poses)
            row = [x for pose in poses for x in pose]
        return self._array(np.array(row, dtype=np.float64).tobytes(), np.dtype(np.float64))

    def _image(self, message: Any) -> bytes:  # noqa: ANN401
        if message.format != self.descriptor.unit:
            raise CorruptDataError(
                f"{self.descriptor.name}: got format {message.format!r}, "
                f"expected {self.descriptor.unit!r}"
            )
        if not message.data:
            raise CorruptDataError(f"{self.descriptor.name}: a {self.message} has no field 'data'")
        return cast(bytes, message.data)

    def _pose(self, message: Any, position: str, rotation: str) -> list[float]:  # noqa: ANN401
        t, q = self._part(message, position), self._part(message, rotation)
        return [t.x, t.y, t.z, q.w, q.x, q.y, q.z]

    def _array(self, data: bytes, wire_dtype: np.dtype[Any]) -> np.ndarray:
        if len(data) != self._num_elements * wire_dtype.itemsize:
            raise CorruptDataError(
                f"{self.descriptor.name}: got a sample of {len(data)} bytes, expected "
                f"{self.descriptor.shape} of {wire_dtype.itemsize} bytes each"
            )
        array, dtype = np.frombuffer(data, dtype=wire_dtype), self.descriptor.numpy_dtype()
        if dtype.kind == "u" and array.size and int(array.max()) >> (8 * dtype.itemsize):
            raise CorruptDataError(
                f"{self.descriptor.name}: got {int(array.max())}, expected numbers of {dtype}"
            )
        return array.astype(dtype, copy=False).reshape(self.descriptor.shape)


def _set_time(timestamp: Any, t_ns: int) -> None:  # noqa: ANN401
    """Negative times have negative seconds and positive nanoseconds."""
    timestamp.seconds, timestamp.nanos = divmod(t_ns, _NS_PER_S)


def _set_pose(translation: Any, rotation: Any, pose: np.ndarray) -> None:  # noqa: ANN401
    # Fields that were never touched are absent, and so is an all-zero part without this.
    translation.SetInParent()
    rotation.SetInParent()
    translation.x, translation.y, translation.z = pose[:3].tolist()
    rotation.w, rotation.x, rotation.y, rotation.z = pose[3:].tolist()


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
    message = new_message(CALIBRATION)
    _set_time(message.timestamp, t_ns)
    message.frame_id, message.distortion_model = frame, "plumb_bob"
    message.height, message.width = shape_px
    message.D.extend(np.asarray(distortion, dtype=np.float64).tolist())
    message.K.extend(K.ravel().tolist())
    message.R.extend(np.eye(3).ravel().tolist())
    message.P.extend(np.hstack([K, np.zeros((3, 1))]).ravel().tolist())
    return cast(bytes, message.SerializeToString())
