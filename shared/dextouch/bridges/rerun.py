"""Export of an episode or recording to a Rerun `.rrd` file, for viewing only."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.components import ImageFormat

from dextouch.bridges.export_files import Block, Reader, TouchPictures, blocks, new_file, touch_side
from dextouch.bridges.import_rerun import opened_rrd
from dextouch.episodes import EpisodeReader, is_keyframe
from dextouch.errors import InvalidInputError, StorageError
from dextouch.schemas import json_ready
from dextouch.streams import HEAD_CAMERA, StreamDescriptor

APPLICATION: Final = "dextouch"
AXIS_LENGTH_M: Final = 0.05
POINT_RADIUS_M: Final = 0.004
# Columns of the entities of a stream.
_Columns = Callable[[Block], dict[str, Any]]


def export_rrd(reader: Reader, path: Path, *, overwrite: bool = False) -> int:
    """Write one episode or recording for the Rerun viewer, and return the number of samples.

    The timeline is `t_ref` (episode) or `t_host` (recording). Encoded images are not decoded.

    Raises:
        ConflictError: the file exists, and is not to be overwritten.
        InvalidInputError: a stream that Rerun cannot display.
        StorageError: the write failed.
    """
    attributes = reader.attributes
    with new_file(path, overwrite=overwrite) as path_partial:
        stream = rr.RecordingStream(APPLICATION, recording_id=reader.item_id)
        try:
            stream.save(path_partial, default_blueprint=_blueprint(reader))
            attributes_json = json.dumps(json_ready(attributes), indent=2)
            text = rr.TextDocument(f"```json\n{attributes_json}\n```", media_type="text/markdown")
            stream.log("attributes", text, static=True)
            stream.send_property(
                "dextouch",
                rr.AnyValues(
                    task=attributes.task,
                    instruction=attributes.instruction,
                    content_sha256=reader.content_sha256,
                ),
            )
            _log_pinhole(stream, reader)
            num_samples = sum(_log(stream, reader, d) for d in reader.streams.values())
            stream.flush()
        except RuntimeError as error:
            raise StorageError(f"write {path}: {error}") from error
        finally:
            stream.disconnect()
        # What fails while the end is written is only logged.
        if lacks := opened_rrd(path_partial)[1]:
            raise StorageError(
                f"write {path}: its end is missing ({lacks[0]}); free space and try again"
            )
        return num_samples


def entity_of(descriptor: StreamDescriptor) -> str:
    """Entity path of a stream; children of a pose entity move with it."""
    name = descriptor.name
    if descriptor.kind == "pose":
        return f"world/{HEAD_CAMERA}" if name == "head" else f"world/{name}"
    if descriptor.kind == "keypoints":
        return f"world/{descriptor.frame}/{name}" if descriptor.frame else f"world/{name}"
    if descriptor.kind == "image":
        return f"world/{name}/image" if name == HEAD_CAMERA else f"cameras/{name}"
    return f"tactile/{name}" if descriptor.kind == "tactile" else f"numbers/{name}"


def _blueprint(reader: Reader) -> rrb.Blueprint:
    """Viewer layout: 3D view and plots on the left, cameras in the middle, touch on the right."""
    columns = [
        rrb.Vertical(
            rrb.Spatial3DView(origin="world", name="space"),
            rrb.TimeSeriesView(origin="numbers", name="joints and actions"),
        )
    ]
    for kind in ("image", "tactile"):
        entities = [entity_of(stream) for stream in reader.streams.values() if stream.kind == kind]
        views = [rrb.Spatial2DView(origin=e, name=e.split("/")[1]) for e in entities]
        if views:
            columns.append(rrb.Vertical(*views))
    return rrb.Blueprint(rrb.Horizontal(*columns), collapse_panels=True)


def _log_pinhole(stream: rr.RecordingStream, reader: Reader) -> None:
    camera = reader.streams.get(HEAD_CAMERA)
    K = reader.attributes.calibration.get("K_head")
    if isinstance(reader, EpisodeReader):
        K = reader.attributes.K_head
    if camera is None or K is None:
        return
    height_px, width_px = camera.shape[:2]
    pinhole = rr.Pinhole(image_from_camera=np.array(K), width=width_px, height=height_px)
    stream.log(entity_of(camera), pinhole, static=True)
    distortion = np.array(reader.attributes.calibration.get("distortion_head", 0.0)).ravel()
    if distortion.any():
        # Rerun's pinhole has no distortion model: what is projected is off by the distortion.
        note = "images are distorted, the pinhole is not: projected entities are off"
        parts = {"distortion_k1_k2_p1_p2_k3": distortion, "note": note}
        lens = rr.DynamicArchetype("dextouch.Lens", components=parts)
        stream.log(entity_of(camera), lens, static=True)


def _log(stream: rr.RecordingStream, reader: Reader, descriptor: StreamDescriptor) -> int:
    entity, kind, num_samples = entity_of(descriptor), descriptor.kind, 0
    if kind == "image":
        columns = _images(stream, entity, descriptor)
    elif kind == "tactile" and touch_side(descriptor):
        columns = _touch(stream, entity, reader, descriptor)
    elif kind == "pose" and descriptor.shape[-1:] == (7,):
        columns = _poses(stream, entity, descriptor)
    elif kind == "keypoints" and descriptor.shape[-1:] == (3,):
        columns = partial(_points, entity)
    else:
        columns = partial(_numbers, entity)
    timeline = "t_ref" if isinstance(reader, EpisodeReader) else "t_host"
    for block in blocks(reader, descriptor.name):
        time = rr.TimeColumn(timeline, duration=block.t_ns.astype("timedelta64[ns]"))
        for each, found in columns(block).items():
            stream.send_columns(each, [time], found)
        num_samples += len(block)
    return num_samples


def _images(stream: rr.RecordingStream, entity: str, descriptor: StreamDescriptor) -> _Columns:
    if descriptor.unit == "jpeg":
        return lambda block: {
            entity: rr.EncodedImage.columns(
                blob=list(block.values), media_type=["image/jpeg"] * len(block)
            )
        }
    if descriptor.unit == "h264":
        stream.log(entity, rr.VideoStream(codec=rr.VideoCodec.H264), static=True)
        return lambda block: {
            entity: rr.VideoStream.columns(
                sample=list(block.values), is_keyframe=[is_keyframe(unit) for unit in block.values]
            )
        }
    shape, dtype = descriptor.shape, descriptor.dtype
    if dtype == "uint16" and len(shape) == 2:
        _log_format(stream, entity, shape, rr.DepthImage)
        if descriptor.unit == "mm":
            stream.log(entity, rr.DepthImage.from_fields(meter=1000.0), static=True)
        return lambda block: {entity: _pixels(block.values, rr.DepthImage)}
    if dtype != "uint8" or (len(shape) != 2 and shape[2:] != (3,)):
        raise InvalidInputError(
            f"{descriptor.name}: got images of {dtype} {shape}, expected uint8 [h, w, 3], "
            "uint8 or uint16 [h, w], JPEG or H.264"
        )
    _log_format(stream, entity, shape)
    return lambda block: {entity: _pixels(block.values)}


def _log_format(
    stream: rr.RecordingStream,
    entity: str,
    shape: tuple[int, ...],
    archetype: "type[rr.Image | rr.DepthImage]" = rr.Image,
) -> None:
    """The form of images: depths of 16 bits, RGB or gray of 8."""
    is_depth = archetype is rr.DepthImage
    kind = ImageFormat(
        width=shape[1],
        height=shape[0],
        color_model=None if is_depth else rr.ColorModel.RGB if shape[2:] else rr.ColorModel.L,
        channel_datatype=rr.ChannelDatatype.U16 if is_depth else rr.ChannelDatatype.U8,
    )
    stream.log(entity, archetype.from_fields(format=kind), static=True)


def _pixels(images: np.ndarray, archetype: "type[rr.Image | rr.DepthImage]" = rr.Image) -> Any:  # noqa: ANN401 - the library does not export the type
    pixels = np.ascontiguousarray(images).reshape(len(images), -1)
    return archetype.columns(buffer=pixels.astype(pixels.dtype.newbyteorder("<")).view(np.uint8))


def _touch(
    stream: rr.RecordingStream, entity: str, reader: Reader, descriptor: StreamDescriptor
) -> _Columns:
    pictures = TouchPictures(reader, descriptor)
    _log_format(stream, entity, pictures.shape)
    return lambda block: {entity: _pixels(pictures.draw(block.values))}


def _poses(stream: rr.RecordingStream, entity: str, descriptor: StreamDescriptor) -> _Columns:
    single = len(descriptor.shape) == 1
    entities = [entity] if single else [f"{entity}/{n}" for n in range(descriptor.shape[0])]
    for each in entities:
        stream.log(each, rr.TransformAxes3D(AXIS_LENGTH_M), static=True)

    def columns(block: Block) -> dict[str, Any]:
        poses = block.values.reshape(len(block), -1, 7)
        q_xyzw = np.roll(poses[..., 3:], -1, axis=-1)
        return {
            each: rr.Transform3D.columns(
                translation=poses[:, index, :3], quaternion=q_xyzw[:, index]
            )
            for index, each in enumerate(entities)
        }

    return columns


def _points(entity: str, block: Block) -> dict[str, Any]:
    num_points = int(np.prod(block.values.shape[1:-1]))
    columns = rr.Points3D.columns(
        positions=block.values.reshape(-1, 3),
        radii=np.full(len(block) * num_points, POINT_RADIUS_M),
    )
    return {entity: columns.partition([num_points] * len(block))}


def _numbers(entity: str, block: Block) -> dict[str, Any]:
    rows = block.values.reshape(len(block), -1).astype(np.float64)
    columns = rr.Scalars.columns(scalars=rows.ravel())
    return {entity: columns.partition([rows.shape[1]] * len(block))}
