"""Lossless codec between samples of a stream and their MCAP messages.

Messages are Foxglove's for images, poses and joints, and our own for actions and other numbers.
Every message has two more fields than its public schema
(https://docs.foxglove.dev/docs/sdk/schemas): the device stamp and counter of a recorded sample, for
which MCAP's own fields are too narrow.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, cast

import numpy as np
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    CompressedVideo_pb2,
    FrameTransform_pb2,
    JointStates_pb2,
    PosesInFrame_pb2,
    RawImage_pb2,
)
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from jaxtyping import Shaped

from dextouch.bridges.export_files import SEQUENCE, T_DEVICE
from dextouch.errors import CorruptDataError
from dextouch.geometry import DISTORTION_MODEL
from dextouch.hands import actions as act
from dextouch.hands.robot_hand import SIDES, RobotHand
from dextouch.streams import StreamDescriptor

CALIBRATION: Final = "foxglove.CameraCalibration"
COMPRESSED_IMAGE: Final = "foxglove.CompressedImage"
COMPRESSED_VIDEO: Final = "foxglove.CompressedVideo"
RAW_IMAGE: Final = "foxglove.RawImage"
FRAME_TRANSFORM: Final = "foxglove.FrameTransform"
POSES_IN_FRAME: Final = "foxglove.PosesInFrame"
JOINT_STATES: Final = "foxglove.JointStates"
ACTION: Final = "dextouch.Action"
ACTIONS: Final = ("action", "action_commanded")
# Fields of an action, in the order of its numbers.
ACTION_PARTS: Final = dict(
    zip(
        ("wrist_left", "wrist_right", "joints_left", "joints_right", "camera_head"),
        act.PARTS,
        strict=True,
    )
)
# The message, element type and dtype on the wire for each dtype of a stream.
ARRAYS: Final = {
    "float32": ("dextouch.Float32Array", "float", "<f4"),
    "float64": ("dextouch.Float64Array", "double", "<f8"),
    "int64": ("dextouch.Int64Array", "sfixed64", "<i8"),
    "uint16": ("dextouch.UInt16Array", "fixed32", "<u4"),
    "uint8": ("dextouch.UInt8Array", "fixed32", "<u4"),
}
# Any of ARRAYS with `values` as raw bytes. A packed repeated field has the same encoding, so a row
# is copied verbatim: the lists of the typed messages lose the payload of a NaN and are slow.
PACKED_ARRAY: Final = "dextouch.PackedArray"
PACKED_ACTION: Final = "dextouch.PackedAction"
_PACKED: Final = {ACTION: PACKED_ACTION} | {name: PACKED_ARRAY for name, _, _ in ARRAYS.values()}
RAW_ENCODINGS: Final = {("uint8", 3): "rgb8", ("uint8", 2): "mono8", ("uint16", 2): "mono16"}
_TIMESTAMP_FILE = "google/protobuf/timestamp.proto"
_ONE, _MANY = FieldDescriptorProto.LABEL_OPTIONAL, FieldDescriptorProto.LABEL_REPEATED
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

    Without `named`, joints and actions are arrays, as in files of bridge version 1.
    """

    def __init__(self, descriptor: StreamDescriptor, *, named: bool = True) -> None:
        self.descriptor, self.message = descriptor, _message_of(descriptor, named=named)
        self._num_elements = math.prod(descriptor.shape)
        self._is_encoded = self.message in {COMPRESSED_IMAGE, COMPRESSED_VIDEO}
        self._joints = joint_names(descriptor)
        # Each sample overwrites the fields that change.
        self._sent = self._constant()

    def _empty(self) -> Any:  # noqa: ANN401 - protobuf makes its fields at run time
        return _new_message(_PACKED.get(self.message, self.message))

    def _constant(self) -> Any:  # noqa: ANN401
        descriptor, sent = self.descriptor, self._empty()
        if self.message == FRAME_TRANSFORM:
            sent.parent_frame_id = descriptor.frame or "world"
            sent.child_frame_id = _frame_of(descriptor)
        elif self.message == POSES_IN_FRAME:
            sent.frame_id = descriptor.frame or "world"
        elif self.message == JOINT_STATES:
            for name in self._joints:
                sent.joints.add(name=name)
        else:
            sent.frame_id = _frame_of(descriptor)
        if self._is_encoded:
            sent.format = descriptor.unit
        elif self.message == RAW_IMAGE:
            sent.height, sent.width = descriptor.shape[:2]
            sent.encoding = raw_encoding(descriptor)
            sent.step = math.prod(descriptor.shape[1:]) * descriptor.numpy_dtype().itemsize
        elif _PACKED.get(self.message) == PACKED_ARRAY:
            sent.shape.extend(descriptor.shape)
        return sent

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
        else:
            self._set_numbers(message, value)
        return cast(bytes, message.SerializeToString())

    def _set_numbers(self, message: Any, value: np.ndarray) -> None:  # noqa: ANN401
        if self.message == FRAME_TRANSFORM:
            _set_pose(message.translation, message.rotation, value)
        elif self.message == POSES_IN_FRAME:
            del message.poses[:]
            for row in value:
                pose = message.poses.add()
                _set_pose(pose.position, pose.orientation, row)
        elif self.message == JOINT_STATES:
            for joint, position in zip(message.joints, value.tolist(), strict=True):
                joint.position = position
        elif self.message == ACTION:
            for name, part in ACTION_PARTS.items():
                setattr(message, name, value[part].astype("<f8").tobytes())
        else:
            message.values = value.astype(self._wire_dtype()).tobytes()

    def _wire_dtype(self) -> np.dtype[Any]:
        return np.dtype(ARRAYS[self.descriptor.dtype][2])

    def decode(self, data: bytes) -> Sent:
        """Decode a message; raises CorruptDataError for bytes that are none of this stream.

        A missing device field becomes 0.
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
        if self.message == ACTION:
            return self._array(self._action(message), np.dtype("<f8"))
        if self.message == JOINT_STATES:
            return self._array(self._positions(message), np.dtype("<f8"))
        if self.message.startswith("dextouch."):
            return self._array(message.values, self._wire_dtype())
        if self.message == FRAME_TRANSFORM:
            row = self._pose(message, "translation", "rotation")
        else:
            poses = (self._pose(pose, "position", "orientation") for pose in message.poses)
            row = [x for pose in poses for x in pose]
        return self._array(np.array(row, dtype=np.float64).tobytes(), np.dtype(np.float64))

    def _action(self, message: Any) -> bytes:  # noqa: ANN401
        parts = {name: cast(bytes, getattr(message, name)) for name in ACTION_PARTS}
        for name, part in ACTION_PARTS.items():
            if len(parts[name]) != 8 * (part.stop - part.start):
                raise CorruptDataError(
                    f"{self.descriptor.name}: got {len(parts[name]) / 8:g} numbers of {name}, "
                    f"expected {part.stop - part.start}"
                )
        return b"".join(parts.values())

    def _positions(self, message: Any) -> bytes:  # noqa: ANN401
        names = tuple(joint.name for joint in message.joints)
        if names != self._joints or not all(joint.HasField("position") for joint in message.joints):
            raise CorruptDataError(
                f"{self.descriptor.name}: got joints {', '.join(names[:3])} …, expected the "
                f"positions of {', '.join(self._joints[:3])} … ({len(self._joints)} joints)"
            )
        return np.array([joint.position for joint in message.joints], dtype="<f8").tobytes()

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
    """A foxglove.CameraCalibration for unrectified images of height and width `shape_px`.

    `K` is the camera matrix in pixels, 3×3, in our convention: Foxglove counts from the centre of
    the first pixel, we from its corner, so the message has half a pixel less. `distortion` is k1
    k2 p1 p2 k3, zeros for a pinhole; `t_ns` the start of its validity.
    """
    K = np.array(K, dtype=np.float64)
    K[:2, 2] -= 0.5
    message = _new_message(CALIBRATION)
    _set_time(message.timestamp, t_ns)
    message.frame_id, message.distortion_model = frame, DISTORTION_MODEL
    message.height, message.width = shape_px
    message.D.extend(np.asarray(distortion, dtype=np.float64).tolist())
    message.K.extend(K.ravel().tolist())
    message.R.extend(np.eye(3).ravel().tolist())
    message.P.extend(np.hstack([K, np.zeros((3, 1))]).ravel().tolist())
    return cast(bytes, message.SerializeToString())


@cache
def _hand_joints() -> dict[str, tuple[str, ...]]:
    return {side: RobotHand(side).joint_names for side in SIDES}


def joint_names(descriptor: StreamDescriptor) -> tuple[str, ...]:
    """Names of the joints whose angles a stream holds, left hand first; empty if it holds none."""
    if (descriptor.kind, descriptor.unit, descriptor.dtype) != ("robot_state", "rad", "float64"):
        return ()
    hands = _hand_joints()
    both = (*hands["left"], *hands["right"])
    if descriptor.shape == (len(both),):
        return both
    side = next((side for side in SIDES if descriptor.name.endswith(f"_{side}")), None)
    one = hands.get(descriptor.side or side or "", ())
    return one if descriptor.shape == (len(one),) else ()


def _message_of(descriptor: StreamDescriptor, *, named: bool) -> str:
    """The full name of the message that holds one sample of a stream."""
    if named and joint_names(descriptor):
        return JOINT_STATES
    size_and_type = (descriptor.shape, descriptor.dtype)
    if named and descriptor.name in ACTIONS and size_and_type == ((act.ACTION_DIM,), "float64"):
        return ACTION
    encoded = {"jpeg": COMPRESSED_IMAGE, "h264": COMPRESSED_VIDEO}
    if descriptor.unit in encoded:
        return encoded[descriptor.unit]
    shape, dtype = descriptor.shape, descriptor.dtype
    if descriptor.kind == "image" and raw_encoding(descriptor):
        return RAW_IMAGE
    if descriptor.kind == "pose" and dtype == "float64" and shape[-1:] == (7,) and len(shape) < 3:
        return FRAME_TRANSFORM if len(shape) == 1 else POSES_IN_FRAME
    return ARRAYS[dtype][0]


def raw_encoding(descriptor: StreamDescriptor) -> str:
    """Foxglove's name of the pixel format; empty where it has none."""
    shape = descriptor.shape
    encoding = RAW_ENCODINGS.get((descriptor.dtype, len(shape)), "")
    return "" if encoding == "rgb8" and shape[2] != 3 else encoding


def _frame_of(descriptor: StreamDescriptor) -> str:
    """The child frame of a pose stream, or the frame in which other values are expressed."""
    if descriptor.kind == "pose":
        return "camera_head" if descriptor.name == "head" else descriptor.name
    return descriptor.frame or descriptor.name


def _new_message(name: str) -> Any:  # noqa: ANN401
    return GetMessageClass(_pool().FindMessageTypeByName(name))()


def descriptor_set(name: str) -> bytes:
    """A serialized `FileDescriptorSet` of one message and all that it needs, dependencies first."""
    files: dict[str, FileDescriptorProto] = {}
    _collect(_pool().FindFileContainingSymbol(name), files)
    return FileDescriptorSet(file=files.values()).SerializeToString()


def _collect(file: FileDescriptor, files: dict[str, FileDescriptorProto]) -> None:
    """Add a file to others, after all that it needs."""
    for dependency in file.dependencies:
        _collect(dependency, files)
    if file.name not in files:
        file.CopyToProto(files.setdefault(file.name, FileDescriptorProto()))


@cache
def _pool() -> Any:  # noqa: ANN401 - not an instance of the class that makes it
    """A pool beside the default one, whose messages of the same names lack our fields."""
    files: dict[str, FileDescriptorProto] = {}
    _collect(CameraCalibration_pb2.DESCRIPTOR, files)
    for module in (
        CompressedImage_pb2,
        CompressedVideo_pb2,
        FrameTransform_pb2,
        JointStates_pb2,
        PosesInFrame_pb2,
        RawImage_pb2,
    ):
        _collect(module.DESCRIPTOR, files)
        _add_device_fields(files[module.DESCRIPTOR.name].message_type[0])
    for message, element, _ in ARRAYS.values():
        files[message] = _file(message, {"shape": "fixed32", "values": element})
    files[PACKED_ARRAY] = _file(PACKED_ARRAY, {"shape": "fixed32", "values": "bytes"})
    for message, element in ((ACTION, "double"), (PACKED_ACTION, "bytes")):
        files[message] = _file(message, dict.fromkeys(ACTION_PARTS, element))
    pool = DescriptorPool()
    for file in files.values():
        pool.Add(file)
    return pool


def _add_device_fields(message: DescriptorProto) -> None:
    for number, name in ((1001, T_DEVICE), (1002, SEQUENCE)):
        message.field.add(name=name, number=number, label=_ONE, type=_type("sfixed64"))


def _file(name: str, lists: dict[str, str]) -> FileDescriptorProto:
    """A file with one message: the time, the frame and lists of numbers, or their bytes."""
    package, short = name.split(".")
    file = FileDescriptorProto(
        name=f"{package}/{short}.proto",
        package=package,
        dependency=[_TIMESTAMP_FILE],
        syntax="proto3",
    )
    message = file.message_type.add(name=short)
    kinds = {"timestamp": "message", "frame_id": "string"} | lists
    for number, (field, kind) in enumerate(kinds.items(), 1):
        label = _MANY if field in lists and kind != "bytes" else _ONE
        message.field.add(name=field, number=number, label=label, type=_type(kind))
    message.field[0].type_name = ".google.protobuf.Timestamp"
    _add_device_fields(message)
    return file


def _type(name: str) -> FieldDescriptorProto.Type.ValueType:
    return FieldDescriptorProto.Type.Value(f"TYPE_{name.upper()}")
