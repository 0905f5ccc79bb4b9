"""Protobuf message types of the streams in MCAP.

Images and poses use the public Foxglove messages (https://docs.foxglove.dev/docs/sdk/schemas),
everything else an array message of our own. Fields 1001 and 1002 are our extension of every
message: the device stamp and counter of a recorded sample, for which MCAP's own fields are too
narrow.
"""

from typing import Final

import numpy as np

from dextouch.bridges.mcap.protobuf import Field, Table
from dextouch.streams import StreamDescriptor

T_DEVICE: Final = "dextouch_t_device_ns"
SEQUENCE: Final = "dextouch_sequence"
CALIBRATION: Final = "foxglove.CameraCalibration"
COMPRESSED_IMAGE: Final = "foxglove.CompressedImage"
COMPRESSED_VIDEO: Final = "foxglove.CompressedVideo"
RAW_IMAGE: Final = "foxglove.RawImage"
FRAME_TRANSFORM: Final = "foxglove.FrameTransform"
POSES_IN_FRAME: Final = "foxglove.PosesInFrame"
# The message and wire type of each dtype; all are packed, so that a row is copied verbatim.
ARRAYS: Final = {
    "float32": ("dextouch.Float32Array", "float"),
    "float64": ("dextouch.Float64Array", "double"),
    "int64": ("dextouch.Int64Array", "sfixed64"),
    "uint16": ("dextouch.UInt16Array", "fixed32"),
    "uint8": ("dextouch.UInt8Array", "fixed32"),
}
RAW_ENCODINGS: Final = {("uint8", 3): "rgb8", ("uint8", 2): "mono8", ("uint16", 2): "mono16"}

_TIME = Field(1, "timestamp", "google.protobuf.Timestamp")
_OURS = (Field(1001, T_DEVICE, "sfixed64"), Field(1002, SEQUENCE, "sfixed64"))


def _array(kind: str) -> tuple[Field, ...]:
    return (
        _TIME,
        Field(2, "frame_id", "string"),
        Field(3, "shape", "fixed32", repeated=True),
        Field(4, "values", kind, repeated=True),
        *_OURS,
    )


TABLE: Final[Table] = {
    "google.protobuf.Timestamp": (Field(1, "seconds", "int64"), Field(2, "nanos", "int32")),
    "foxglove.Vector3": tuple(Field(n, axis, "double") for n, axis in enumerate("xyz", 1)),
    "foxglove.Quaternion": tuple(Field(n, axis, "double") for n, axis in enumerate("xyzw", 1)),
    "foxglove.Pose": (
        Field(1, "position", "foxglove.Vector3"),
        Field(2, "orientation", "foxglove.Quaternion"),
    ),
    FRAME_TRANSFORM: (
        _TIME,
        Field(2, "parent_frame_id", "string"),
        Field(3, "child_frame_id", "string"),
        Field(4, "translation", "foxglove.Vector3"),
        Field(5, "rotation", "foxglove.Quaternion"),
        *_OURS,
    ),
    POSES_IN_FRAME: (
        _TIME,
        Field(2, "frame_id", "string"),
        Field(3, "poses", "foxglove.Pose", repeated=True),
        *_OURS,
    ),
    COMPRESSED_IMAGE: (
        _TIME,
        Field(4, "frame_id", "string"),
        Field(2, "data", "bytes"),
        Field(3, "format", "string"),
        *_OURS,
    ),
    COMPRESSED_VIDEO: (
        _TIME,
        Field(2, "frame_id", "string"),
        Field(3, "data", "bytes"),
        Field(4, "format", "string"),
        *_OURS,
    ),
    RAW_IMAGE: (
        _TIME,
        Field(7, "frame_id", "string"),
        Field(2, "width", "fixed32"),
        Field(3, "height", "fixed32"),
        Field(4, "encoding", "string"),
        Field(5, "step", "fixed32"),
        Field(6, "data", "bytes"),
        *_OURS,
    ),
    CALIBRATION: (
        _TIME,
        Field(9, "frame_id", "string"),
        Field(2, "width", "fixed32"),
        Field(3, "height", "fixed32"),
        Field(4, "distortion_model", "string"),
        *(Field(n, name, "double", repeated=True) for n, name in enumerate("DKRP", 5)),
    ),
    **{message: _array(kind) for message, kind in ARRAYS.values()},
}


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
