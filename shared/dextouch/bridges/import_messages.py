"""Samples in the messages of Foxglove and ROS 2, once they are decoded to plain Python values.

Foxglove's schemas (https://docs.foxglove.dev/docs/sdk/schemas) are the same in JSON, protobuf and
ROS 2; those of ROS 2 are its common_interfaces (https://github.com/ros2/common_interfaces). Every
other message becomes a vector of the numbers in it, each with its path as a name.
"""

import base64
import binascii
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np

from dextouch.bridges.export_files import SEQUENCE, T_DEVICE
from dextouch.bridges.import_images import (
    check_codec,
    compressed_form,
    decode_png,
    decode_raw,
    raw_form,
)
from dextouch.bridges.import_recording import whole_text
from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError
from dextouch.geometry import DISTORTION_MODEL, NUM_DISTORTION
from dextouch.streams import JPEG_UNIT, NO_DEVICE_TIME, StreamKind

MAX_POINTS: Final = 1 << 18
MAX_POINT_FIELDS: Final = 64
MAX_NUMBERS: Final = 4096
# Unit of a stream of video packets before they are kept or decoded.
VIDEO_UNIT: Final = "video "
POSE_UNIT: Final = "pose_m_wxyz"
NUMBERS_UNIT: Final = "numbers"
CALIBRATIONS: Final = frozenset({"foxglove.CameraCalibration", "sensor_msgs/CameraInfo"})
MAX_DEPTH: Final = 64
# Between the key of a sample and the sorted names of its joints.
GROUP: Final = "\0"
# Whole numbers up to this are exact as float64.
_MAX_EXACT: Final = 1 << 53
_NS_PER_S: Final = 1_000_000_000
_MAX_NS: Final = (1 << 63) - 1
# Types of a point's fields by number: foxglove.PackedElementField and sensor_msgs/PointField.
_FOXGLOVE_TYPES = ("", "u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8")
_ROS_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_ARRAY_DTYPES = {"Float32": "float32", "UInt8": "uint8", "Byte": "uint8", "UInt16": "uint16"}
_INTEGERS = {"Int8", "Int16", "Int32", "Int64", "UInt32", "UInt64"}
Plain = Mapping[str, Any]


@dataclass(frozen=True)
class Form:
    """What all samples of a stream have in common.

    `names` are those of the last axis. `is_padded` marks shapes whose first axis is as long as the
    longest sample's; shorter ones end in NaN. `as_numbers` says why a sample is plain numbers.
    """

    kind: StreamKind
    unit: str
    dtype: str
    shape: tuple[int, ...]
    frame: str | None = None
    names: tuple[str, ...] = ()
    is_padded: bool = False
    as_numbers: str = ""
    notes: tuple[str, ...] = ()

    def matches(self, other: "Form") -> bool:
        """Whether a sample of the other form fits into a stream of this one (see `fit`)."""
        return self._identity() == other._identity()  # noqa: SLF001 - of its own class

    def _identity(self) -> tuple[object, ...]:
        shape = self.shape[1:] if self.is_padded else self.shape
        by_name = self.kind == "robot_state" and len({*self.names}) == len(self.names)
        names = tuple(sorted(self.names)) if by_name else self.names
        # Where whole numbers of a source do not all fit int64, it is float64.
        dtype = "float64" if self.dtype == "int64" else self.dtype
        return self.kind, self.unit, dtype, shape, self.frame, names

    def fit(self, values: np.ndarray, other: "Form") -> np.ndarray:
        """Values of a sample of another form that `matches`: joints in order, points padded."""
        if self.dtype != other.dtype:
            values = values.astype(self.dtype)
        if self.names != other.names:
            return values[[other.names.index(name) for name in self.names]]
        if self.is_padded and len(values) < self.shape[0]:
            padded = np.full(self.shape, np.nan, dtype=values.dtype)
            padded[: len(values)] = values
            return padded
        return values

    def describe(self) -> str:
        """Unit, type of numbers and shape, for messages."""
        unit = f"{self.unit} {self.dtype}" if self.unit == NUMBERS_UNIT else self.unit
        return f"{unit} {list(self.shape)}" + (f" in {self.frame!r}" if self.frame else "")


@dataclass(frozen=True)
class Item:
    """One sample of a message; `key` tells apart the streams of one topic, `decode` gives values.

    `t_device_ns` is the stamp in the message, NO_DEVICE_TIME without one.
    """

    key: str
    form: Form
    t_device_ns: int
    decode: Callable[[], np.ndarray | bytes]


@dataclass(frozen=True)
class CameraModel:
    """A camera's calibration; `K` (3×3) has its principal point in our convention.

    Foxglove and ROS count from the centre of the first pixel, we from its corner: half a pixel
    more.
    """

    frame: str | None
    size_px: tuple[int, int]
    K: tuple[float, ...]
    distortion: tuple[float, ...]
    # Of rectified images; None where the calibration has none.
    K_rectified: tuple[float, ...] | None = None


def schema_name(name: str) -> str:
    """One name for the schemas of ROS 2 with and without `msg`, and of Foxglove in ROS 2."""
    return name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove.")


def items_of(schema: str, message: Plain, *, is_typed: bool = True) -> list[Item]:
    """Samples of a message of a schema, by its `schema_name`.

    Without `is_typed`, as of JSON, a number may be whole by chance.

    Raises:
        InvalidInputError: a message that this release cannot read, with the reason.
        CorruptDataError: contents that contradict each other.
        LimitExceededError: too many points, pixels or numbers.
    """
    try:
        if (reader := _READERS.get(schema)) is not None:
            return reader(message)
        package, _, short = schema.rpartition("/")
        if package == "std_msgs" and short.endswith("MultiArray"):
            return [_multi_array(short.removesuffix("MultiArray"), message)]
        if schema.startswith("dextouch.") and "shape" in message:
            return [_our_array(schema, message)]
        ours = {T_DEVICE, SEQUENCE} & message.keys()
        left = {name: value for name, value in message.items() if name not in ours}
        item = _flat(left, is_typed=is_typed)
        return [replace(item, t_device_ns=_stamp_ns(message)) if ours else item]
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise CorruptDataError(
            f"not a valid {schema or 'message'} ({type(error).__name__}: {error})"
        ) from error


def camera_model(message: Plain) -> CameraModel:
    """Read a calibration of Foxglove or ROS 2.

    Raises InvalidInputError for lenses other than plumb_bob's, CorruptDataError for one that is
    none.
    """
    lens = _text(message.get("distortion_model"))
    if lens not in {"", DISTORTION_MODEL}:
        raise InvalidInputError(f"distortion model {lens!r}; expected {DISTORTION_MODEL!r}")
    try:
        K = _numbers(message.get("K", message.get("k"))).astype(np.float64).ravel()
        D = _numbers(message.get("D", message.get("d", []))).astype(np.float64).ravel()
        P = _numbers(message.get("P", message.get("p", []))).astype(np.float64).ravel()
        size_px = int(message["height"]), int(message["width"])
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptDataError(f"not a valid calibration ({error})") from error
    if (
        K.shape != (9,)
        or D.size > NUM_DISTORTION
        or not (np.isfinite(K).all() and K[0] > 0 and K[4] > 0)
    ):
        raise CorruptDataError(f"calibration with K of {K.size} and D of {D.size} numbers: {K}")
    rectified = None
    if P.shape == (12,) and np.isfinite(P).all() and P[0] > 0 and P[5] > 0:
        rectified = _from_corner(P.reshape(3, 4)[:, :3])
    distortion = tuple(np.pad(D, (0, NUM_DISTORTION - D.size)).tolist())
    frame = _frame(message) or ""
    return CameraModel(frame, size_px, _from_corner(K.reshape(3, 3)), distortion, rectified)


def _from_corner(K: np.ndarray) -> tuple[float, ...]:
    return tuple((K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])).ravel().tolist())


def _text(value: object) -> str:
    return whole_text(value[:128]) if isinstance(value, str) else ""


def _bytes(value: object) -> bytes:
    """Bytes of a field; JSON has them in base64."""
    if isinstance(value, str):
        try:
            return base64.b64decode(value, validate=True)
        except binascii.Error as error:
            raise CorruptDataError(f"field data is not base64 ({error})") from error
    if isinstance(value, bytes):
        return value
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return value.tobytes()
    raise CorruptDataError(f"field data is {type(value).__name__}, expected bytes")


def _numbers(value: object) -> np.ndarray:
    array = np.asarray(value if value is not None else [])
    if array.size == 0:
        return np.zeros(0)
    if array.dtype.kind not in "biuf":
        raise CorruptDataError(f"got {array.dtype} values, expected numbers")
    return array


def _frame(message: Plain) -> str | None:
    header = message.get("header")
    frame = header.get("frame_id") if isinstance(header, Mapping) else message.get("frame_id")
    return _text(frame) or None


def _stamp_path(message: Plain) -> str:
    """Where the message has its own time; empty if nowhere."""
    header = message.get("header")
    if isinstance(header, Mapping) and isinstance(header.get("stamp"), Mapping):
        return "header.stamp."
    return "timestamp." if isinstance(message.get("timestamp"), Mapping) else ""


def _stamp_ns(message: Plain) -> int:
    """The message's own time; NO_DEVICE_TIME without one, and for 0, which means the same."""
    path = _stamp_path(message)
    if T_DEVICE in message:
        t_ns = int(message[T_DEVICE])
    elif path:
        stamp = message["header"]["stamp"] if path == "header.stamp." else message["timestamp"]
        seconds = stamp.get("sec", stamp.get("seconds", 0))
        nanos = stamp.get("nsec", stamp.get("nanosec", stamp.get("nanos", 0)))
        # Some write the whole time as seconds.
        whole_s = int(seconds)
        t_ns = whole_s * _NS_PER_S + int(nanos) + round((float(seconds) - whole_s) * _NS_PER_S)
    else:
        return NO_DEVICE_TIME
    return t_ns if 0 < t_ns <= _MAX_NS else NO_DEVICE_TIME


def _item(message: Plain, form: Form, decode: Callable[[], Any], *, key: str = "") -> Item:
    return Item(key, form, _stamp_ns(message), decode)


def _array_item(message: Plain, form: Form, values: np.ndarray, *, key: str = "") -> Item:
    array = np.ascontiguousarray(values, dtype=np.dtype(form.dtype).newbyteorder("<"))
    return _item(message, form, array.reshape(form.shape).copy, key=key)


def _xyz(part: Plain | None) -> list[float]:
    part = part or {}
    return [float(part.get(axis) or 0.0) for axis in "xyz"]


def _pose(position: Plain | None, rotation: Plain | None) -> list[float]:
    """Row x y z w qx qy qz; an absent rotation is the zero quaternion of an invalid sample."""
    return [*_xyz(position), float((rotation or {}).get("w") or 0.0), *_xyz(rotation)]


def _pose_item(message: Plain, pose: list[float], frame: str | None, *, key: str = "") -> Item:
    form = Form("pose", POSE_UNIT, "float64", (7,), frame)
    return _array_item(message, form, np.array(pose), key=key)


def encoded_image(data: bytes) -> tuple[Form, Callable[[], np.ndarray | bytes]]:
    """Form and decoder of a JPEG, which is kept, or a PNG."""
    unit, dtype, shape, data = compressed_form(data)
    form = Form("image", unit, dtype, shape)
    if unit == JPEG_UNIT:
        return form, lambda: data
    return replace(form, notes=("PNG decoded",)), partial(decode_png, data, shape, dtype)


def raw_image(
    encoding: str, size_px: tuple[int, int], step: int, data: bytes, *, big_endian: bool = False
) -> tuple[Form, Callable[[], np.ndarray]]:
    """Form and decoder of raw pixels, with rows of `step` bytes."""
    unit, dtype, shape = raw_form(encoding, *size_px, step, data)
    form = Form("image", unit, dtype, shape)
    if dtype == "float32":
        form = replace(form, kind="scalar", as_numbers=f"pixels {encoding}")
    return form, partial(decode_raw, encoding, shape, step, data, big_endian=big_endian)


def _compressed_image(message: Plain) -> list[Item]:
    data = _bytes(message["data"])
    form, decode = encoded_image(data)
    if _text(message.get("format")).startswith("32FC1") and form.unit == "mono16":
        # compressed_depth_image_transport has quantised inverse depths, by two numbers before them.
        a, b = struct.unpack_from("<ff", data, 4)
        form = replace(form, kind="scalar", unit="m", dtype="float32", as_numbers="pixels 32FC1")
        decode = partial(_depths_m, decode, a, b)
    return [_item(message, replace(form, frame=_frame(message)), decode)]


def _depths_m(decode: Callable[[], np.ndarray | bytes], a: float, b: float) -> np.ndarray:
    """Depths of quantised inverse ones, which are 0 where there is none."""
    inverse = np.asarray(decode()).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(inverse > 0, a / (inverse - b), np.nan).astype(np.float32)


def _raw_image(message: Plain) -> list[Item]:
    encoding, data = _text(message.get("encoding")), _bytes(message["data"])
    size_px, step = (int(message["height"]), int(message["width"])), int(message["step"])
    big_endian = bool(message.get("is_bigendian"))
    form, decode = raw_image(encoding, size_px, step, data, big_endian=big_endian)
    return [_item(message, replace(form, frame=_frame(message)), decode)]


def _video(message: Plain) -> list[Item]:
    data, codec = _bytes(message["data"]), _text(message.get("format"))
    check_codec(codec)
    form = Form("image", VIDEO_UNIT + codec, "uint8", (), _frame(message))
    return [_item(message, form, lambda: data)]


def _transforms(message: Plain) -> list[Item]:
    return [_child_transform(one) for one in message["transforms"]]


def _child_transform(message: Plain) -> Item:
    """A transform, which is the pose of the child in its parent."""
    inner = message.get("transform", message)
    child = _text(message.get("child_frame_id"))
    parent = _text(message.get("parent_frame_id")) or _frame(message)
    pose = _pose(inner.get("translation"), inner.get("rotation"))
    return _pose_item(message, pose, parent, key=child)


def _pose_message(message: Plain) -> list[Item]:
    pose = message.get("pose") or {}
    row = _pose(pose.get("position"), pose.get("orientation"))
    return [_pose_item(message, row, _frame(message))]


def _poses_message(message: Plain) -> list[Item]:
    rows = [_pose(one.get("position"), one.get("orientation")) for one in message["poses"]]
    if not rows or len(rows) > MAX_POINTS:
        raise InvalidInputError(f"message with {len(rows)} poses, expected 1 … {MAX_POINTS}")
    form = Form("pose", POSE_UNIT, "float64", (len(rows), 7), _frame(message))
    return [_array_item(message, form, np.array(rows))]


def _point_cloud(types: tuple[str, ...], message: Plain) -> list[Item]:
    """Points with all their fields, padded with NaN to those of the largest cloud."""
    data = _bytes(message["data"])
    stride = int(message.get("point_stride", message.get("point_step", 0)))
    fields = message["fields"]
    if not 1 <= len(fields) <= MAX_POINT_FIELDS or stride < 1:
        raise CorruptDataError(f"point cloud with {len(fields)} fields in {stride} bytes")
    big_endian = bool(message.get("is_bigendian"))
    names, formats, offsets = [], [], []
    for field in fields:
        number, count = int(field.get("type", field.get("datatype"))), int(field.get("count", 1))
        # PCL, too, takes the count 0 that some drivers write for 1.
        if not 1 <= number < len(types) or count not in {0, 1}:
            what = f"{count} numbers of type {number}"
            raise InvalidInputError(f"point field {field.get('name')!r} of {what}, expected one")
        names.append(_text(field["name"]))
        formats.append((">" if big_endian else "<") + types[number])
        offsets.append(int(field["offset"]))
    height, width, row_step = 1, len(data) // stride, len(data)
    if "point_step" in message:
        width, height = int(message["width"]), int(message["height"])
        # Of a single row drivers write anything here.
        row_step = int(message["row_step"]) if height > 1 else width * stride
    row = width * stride
    if width * height > MAX_POINTS:
        raise LimitExceededError(f"{width * height} points, expected at most {MAX_POINTS}")
    if min(width, height) < 0 or row_step < row or len(data) < (height - 1) * row_step + row:
        raise CorruptDataError(f"{len(data)} bytes for {height} x {width} points")
    if any(
        o < 0 or o + np.dtype(f).itemsize > stride for o, f in zip(offsets, formats, strict=True)
    ):
        raise CorruptDataError("point cloud with a field beyond its points")
    wide = any(one[1:] in {"f8", "i4", "u4"} for one in formats)
    dtype = "float64" if wide else "float32"
    keys = [f"f{k}" for k in range(len(names))]
    record = np.dtype({"names": keys, "formats": formats, "offsets": offsets, "itemsize": stride})
    points = np.ndarray((height, width), record, data, strides=(row_step, stride)).ravel()
    values = np.stack([points[key].astype(dtype) for key in keys], axis=-1)
    form = Form(
        "scalar", NUMBERS_UNIT, dtype, values.shape, _frame(message), tuple(names),
        is_padded=True, as_numbers="points",
    )  # fmt: skip
    if (pose := message.get("pose")) is not None and (moved := _moved(pose)) != _moved({}):
        form = replace(form, notes=(f"pose of the points in their frame left out: {moved}",))
    return [_array_item(message, form, values)]


def _moved(pose: Plain) -> list[float]:
    row = _pose(pose.get("position"), pose.get("orientation"))
    return row if any(row[3:]) else [*row[:3], 1.0, 0.0, 0.0, 0.0]


def _ros_joints(message: Plain) -> list[Item]:
    names = tuple(_text(name) for name in message.get("name", ()))
    parts = (("", "position", "rad"), ("velocity", "velocity", "rad/s"), ("effort", "effort", "Nm"))
    return _joints(
        message, names, [(key, _numbers(message.get(field)), unit) for key, field, unit in parts]
    )


def _foxglove_joints(message: Plain) -> list[Item]:
    joints = message["joints"]
    names = tuple(_text(one.get("name")) for one in joints)
    units = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s²", "effort": "Nm"}
    parts = []
    for field, unit in units.items():
        given = [one.get(field) for one in joints]
        if all(value is None for value in given):
            continue
        values = np.array([math.nan if value is None else float(value) for value in given])
        parts.append(("" if field == "position" else field, values, unit))
    return _joints(message, names, parts)


def _joints(
    message: Plain, names: tuple[str, ...], parts: list[tuple[str, np.ndarray, str]]
) -> list[Item]:
    """A stream for each of positions, velocities and efforts that a message has."""
    items = []
    for key, values, unit in parts:
        if not values.size:
            continue
        if names and len(names) != len(values):
            raise CorruptDataError(f"{len(names)} names for {len(values)} joints")
        form = Form("robot_state", unit, "float64", values.shape, _frame(message), names)
        group = GROUP + GROUP.join(sorted(names)) if names else ""
        items.append(_array_item(message, form, values, key=key + group))
    if not items:
        raise InvalidInputError("message without a joint")
    return items


def _multi_array(element: str, message: Plain) -> Item:
    dtype = "int64" if element in _INTEGERS else _ARRAY_DTYPES.get(element, "float64")
    data = message["data"]
    values = _numbers(data)
    layout = message.get("layout") or {}
    shape = tuple(int(one["size"]) for one in layout.get("dim", ()))
    if not shape or math.prod(shape) != values.size or 0 in shape:
        shape = values.shape
    return _array(message, values, shape, dtype)


def _our_array(schema: str, message: Plain) -> Item:
    """An array of DexTouch in a file that is no export of ours any more."""
    dtype = schema.removeprefix("dextouch.").removesuffix("Array").lower()
    if dtype not in {"float32", "float64", "int64", "uint16", "uint8"}:
        raise InvalidInputError(f"array {schema!r}, which this release does not know")
    values = _numbers(message["values"])
    return _array(message, values, tuple(int(n) for n in message["shape"]), dtype)


def _array(message: Plain, values: np.ndarray, shape: tuple[int, ...], dtype: str) -> Item:
    if not values.size or values.size > MAX_POINTS or math.prod(shape) != values.size:
        raise InvalidInputError(
            f"array of {values.size} numbers and shape {list(shape)}, expected 1 … {MAX_POINTS}"
        )
    form = Form("scalar", NUMBERS_UNIT, dtype, shape, _frame(message))
    return _array_item(message, form, values)


def _flat(message: Plain, *, is_typed: bool) -> Item:
    """All numbers of a message, in its order, with their paths as names."""
    paths: list[tuple[str, int]] = []
    numbers: list[np.ndarray] = []
    skipped: list[str] = []
    rounded: list[str] = []
    size = 0
    used = _stamp_path(message)
    for path, value in _leaves(message, ""):
        if used and path.startswith(used):
            continue
        if isinstance(value, np.ndarray):
            paths.append((path, value.size if value.ndim else -1))
            numbers.append(value.ravel())
            size += value.size
            has_whole = value.dtype.kind in "iu" and value.size
            if has_whole and max(-int(value.min()), int(value.max())) > _MAX_EXACT:
                rounded.append(path)
        elif value not in {None, ""} and path not in {"frame_id", "header.frame_id"}:
            skipped.append(path)
        if size > MAX_NUMBERS or len(skipped) > MAX_NUMBERS:
            raise LimitExceededError(f"message of more than {MAX_NUMBERS} values")
    if not size:
        raise InvalidInputError("message without a number")
    values = np.concatenate([one for one in numbers if one.size])
    is_whole = is_typed and np.can_cast(values.dtype, np.int64)
    dtype = "int64" if is_whole else "float64"
    said = {"left out, not numbers": skipped, "above 2^53, rounded": [] if is_whole else rounded}
    form = Form(
        "scalar", NUMBERS_UNIT, dtype, (size,), _frame(message), _names(tuple(paths)),
        as_numbers="no schema that this release knows",
        notes=tuple(f"{what}: {', '.join(which[:8])}" for what, which in said.items() if which),
    )  # fmt: skip
    return _array_item(message, form, values)


@lru_cache(maxsize=64)
def _names(paths: tuple[tuple[str, int], ...]) -> tuple[str, ...]:
    """Names of numbers (count −1) and of the elements of lists."""
    return tuple(
        whole_text(name[-128:])
        for path, count in paths
        for name in ([path] if count < 0 else [f"{path}[{index}]" for index in range(count)])
    )


def _leaves(value: object, path: str, depth: int = 0) -> Iterator[tuple[str, object]]:
    """Path and value of all in a message; numbers and lists of them as arrays."""
    if depth > MAX_DEPTH:
        raise LimitExceededError(f"message nested more than {MAX_DEPTH} deep")
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _leaves(inner, f"{path}.{name}" if path else str(name), depth + 1)
    elif isinstance(value, bool | int | float | np.ndarray):
        array = np.asarray(value)
        yield path, array if array.dtype.kind in "biuf" and array.ndim < 2 else "array"
    elif isinstance(value, list | tuple):
        if value and all(isinstance(one, bool | int | float) for one in value):
            is_whole = all(isinstance(one, int) and -(2**63) <= one < 2**63 for one in value)
            yield path, np.array(value, dtype=np.int64 if is_whole else np.float64)
            return
        for index, inner in enumerate(value[: MAX_NUMBERS + 1]):
            yield from _leaves(inner, f"{path}[{index}]", depth + 1)
    else:
        yield path, value


_READERS: Final[Mapping[str, Callable[[Plain], list[Item]]]] = {
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CompressedVideo": _video,
    "foxglove.RawImage": _raw_image,
    "foxglove.FrameTransform": lambda message: [_child_transform(message)],
    "foxglove.FrameTransforms": _transforms,
    "foxglove.PoseInFrame": _pose_message,
    "foxglove.PosesInFrame": _poses_message,
    "foxglove.PointCloud": partial(_point_cloud, _FOXGLOVE_TYPES),
    "foxglove.JointStates": _foxglove_joints,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/Image": _raw_image,
    "sensor_msgs/JointState": _ros_joints,
    "sensor_msgs/PointCloud2": partial(_point_cloud, _ROS_TYPES),
    "geometry_msgs/PoseStamped": _pose_message,
    "geometry_msgs/PoseArray": _poses_message,
    "geometry_msgs/TransformStamped": lambda message: [_child_transform(message)],
    "tf2_msgs/TFMessage": _transforms,
}
