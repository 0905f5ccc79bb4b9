"""Protobuf messages of the streams in MCAP: Foxglove's for images and poses, arrays for the rest.

Every message has two more fields than its public schema (https://docs.foxglove.dev/docs/sdk/schemas):
the device stamp and counter of a recorded sample, for which MCAP's own fields are too narrow.
"""

from functools import cache
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    CompressedVideo_pb2,
    FrameTransform_pb2,
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
from google.protobuf.message_factory import GetMessageClass

from dextouch.streams import StreamDescriptor

T_DEVICE: Final = "dextouch_t_device_ns"
SEQUENCE: Final = "dextouch_sequence"
CALIBRATION: Final = "foxglove.CameraCalibration"
COMPRESSED_IMAGE: Final = "foxglove.CompressedImage"
COMPRESSED_VIDEO: Final = "foxglove.CompressedVideo"
RAW_IMAGE: Final = "foxglove.RawImage"
FRAME_TRANSFORM: Final = "foxglove.FrameTransform"
POSES_IN_FRAME: Final = "foxglove.PosesInFrame"
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
RAW_ENCODINGS: Final = {("uint8", 3): "rgb8", ("uint8", 2): "mono8", ("uint16", 2): "mono16"}

_TIMESTAMP_FILE = "google/protobuf/timestamp.proto"
_ONE, _MANY = FieldDescriptorProto.LABEL_OPTIONAL, FieldDescriptorProto.LABEL_REPEATED


def message_of(descriptor: StreamDescriptor) -> str:
    """The full name of the message that holds one sample of a stream."""
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


def frame_of(descriptor: StreamDescriptor) -> str:
    """The child frame of a pose stream, or the frame in which other values are expressed."""
    if descriptor.kind == "pose":
        return "camera_head" if descriptor.name == "head" else descriptor.name
    return descriptor.frame or descriptor.name


def parent_of(descriptor: StreamDescriptor) -> str:
    """The parent frame of a pose stream."""
    return descriptor.frame or "world"


def num_elements(descriptor: StreamDescriptor) -> int:
    """Number of elements of one sample."""
    return int(np.prod(descriptor.shape, dtype=np.int64))


def new_message(name: str) -> Any:  # noqa: ANN401 - protobuf makes its fields at run time
    """An empty message of a full name."""
    return GetMessageClass(_pool().FindMessageTypeByName(name))()


def descriptor_set(name: str) -> bytes:
    """A serialized `FileDescriptorSet` of one message and all that it needs, dependencies first."""
    needed: dict[str, FileDescriptorProto] = {}

    def add(file: str) -> None:
        for dependency in _files()[file].dependency:
            add(dependency)
        needed[file] = _files()[file]

    add(_pool().FindFileContainingSymbol(name).name)
    return FileDescriptorSet(file=needed.values()).SerializeToString()


@cache
def _pool() -> Any:  # noqa: ANN401 - not an instance of the class that makes it
    """A pool beside the default one, whose messages of the same names lack our fields."""
    pool = DescriptorPool()
    for file in _files().values():
        pool.Add(file)
    return pool


@cache
def _files() -> dict[str, FileDescriptorProto]:
    """All files by name, dependencies first."""
    files: dict[str, FileDescriptorProto] = {}

    def add(file: FileDescriptor) -> None:
        for dependency in file.dependencies:
            add(dependency)
        if file.name not in files:
            file.CopyToProto(files.setdefault(file.name, FileDescriptorProto()))

    add(CameraCalibration_pb2.DESCRIPTOR)
    for module in (
        CompressedImage_pb2,
        CompressedVideo_pb2,
        FrameTransform_pb2,
        PosesInFrame_pb2,
        RawImage_pb2,
    ):
        add(module.DESCRIPTOR)
        _add_device_fields(files[module.DESCRIPTOR.name].message_type[0])
    for message, element, _ in ARRAYS.values():
        files[message] = _array_file(message, element, repeated=True)
    files[PACKED_ARRAY] = _array_file(PACKED_ARRAY, "bytes", repeated=False)
    return {file.name: file for file in files.values()}


def _add_device_fields(message: DescriptorProto) -> None:
    for number, name in ((1001, T_DEVICE), (1002, SEQUENCE)):
        message.field.add(name=name, number=number, label=_ONE, type=_type("sfixed64"))


def _array_file(name: str, element: str, *, repeated: bool) -> FileDescriptorProto:
    package, short = name.split(".")
    file = FileDescriptorProto(
        name=f"{package}/{short}.proto",
        package=package,
        dependency=[_TIMESTAMP_FILE],
        syntax="proto3",
    )
    message = file.message_type.add(name=short)
    labels = (_ONE, _ONE, _MANY, _MANY if repeated else _ONE)
    names = {"timestamp": "message", "frame_id": "string", "shape": "fixed32", "values": element}
    for number, ((field, kind), label) in enumerate(zip(names.items(), labels, strict=True), 1):
        message.field.add(name=field, number=number, label=label, type=_type(kind))
    message.field[0].type_name = ".google.protobuf.Timestamp"
    _add_device_fields(message)
    return file


def _type(name: str) -> FieldDescriptorProto.Type.ValueType:
    return FieldDescriptorProto.Type.Value(f"TYPE_{name.upper()}")
