"""Export of an episode or recording to a Rerun `.rrd` file, for viewing only."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import UInt8
from rerun.components import ImageFormat

from dextouch.bridges.blocks import Block, Reader, blocks
from dextouch.bridges.new_file import new_file
from dextouch.episodes import EpisodeReader, is_keyframe
from dextouch.errors import InvalidInputError
from dextouch.schemas import json_ready
from dextouch.streams import StreamDescriptor
from dextouch.tactile import colour, hand_canvas
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, Side, select_taxels

APPLICATION: Final = "dextouch"
HEAD_CAMERA: Final = "camera_head"
FULL_SCALE_KPA: Final = 40.0
AXIS_LENGTH_M: Final = 0.05
POINT_RADIUS_M: Final = 0.004


def export_rrd(reader: Reader, path: Path, *, overwrite: bool = False) -> int:
    """Write one episode or recording for the Rerun viewer.

    The timeline is `t_ref` (episode) or `t_host` (recording). Encoded images are not decoded.

    Args:
        reader: of the episode or recording.
        path: of the new file.
        overwrite: whether an existing file is replaced.

    Returns:
        Number of samples.

    Raises:
        ConflictError: the file exists.
        InvalidInputError: a stream that Rerun cannot display.
        StorageError: the write failed.
    """
    with new_file(path, overwrite=overwrite) as partial:
        export = _Export(reader)
        try:
            export.stream.save(partial, default_blueprint=_blueprint(reader))
            return export.run()
        finally:
            export.stream.disconnect()


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


def _names(reader: Reader, kind: str) -> list[str]:
    return [entity_of(stream) for stream in reader.streams.values() if stream.kind == kind]


def _blueprint(reader: Reader) -> rrb.Blueprint:
    """Viewer layout: 3D view and plots on the left, cameras in the middle, touch on the right."""
    columns = [
        rrb.Vertical(
            rrb.Spatial3DView(origin="world", name="space"),
            rrb.TimeSeriesView(origin="numbers", name="joints and actions"),
        )
    ]
    for kind in ("image", "tactile"):
        views = [rrb.Spatial2DView(origin=e, name=e.split("/")[1]) for e in _names(reader, kind)]
        if views:
            columns.append(rrb.Vertical(*views))
    return rrb.Blueprint(rrb.Horizontal(*columns), collapse_panels=True)


class _Export:
    """One file that is being written."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._timeline = "t_ref" if isinstance(reader, EpisodeReader) else "t_host"
        self.stream = rr.RecordingStream(APPLICATION, recording_id=_id_of(reader))

    def run(self) -> int:
        """Log static entities, then every stream."""
        attributes = self._reader.attributes
        words = json.dumps(json_ready(attributes), indent=2)
        self.stream.log(
            "attributes",
            rr.TextDocument(f"```json\n{words}\n```", media_type="text/markdown"),
            static=True,
        )
        self.stream.send_property(
            "dextouch",
            rr.AnyValues(
                task=attributes.task,
                instruction=attributes.instruction,
                content_sha256=self._reader.content_sha256,
            ),
        )
        self._log_pinhole()
        num_samples = 0
        for descriptor in self._reader.streams.values():
            send = self._sender(descriptor)
            for block in blocks(self._reader, descriptor.name):
                send(block)
                num_samples += len(block)
        self.stream.flush()
        return num_samples

    def _log_pinhole(self) -> None:
        # Rerun's pinhole has no distortion model, so projected entities are off by the distortion.
        camera = self._reader.streams.get(HEAD_CAMERA)
        K = self._reader.attributes.calibration.get("K_head")
        if isinstance(self._reader, EpisodeReader):
            K = self._reader.attributes.K_head
        if camera is None or K is None:
            return
        height_px, width_px = camera.shape[:2]
        pinhole = rr.Pinhole(image_from_camera=np.array(K), width=width_px, height=height_px)
        self.stream.log(entity_of(camera), pinhole, static=True)

    def _sender(self, descriptor: StreamDescriptor) -> Callable[[Block], None]:
        """The function that logs blocks of a stream; logs the static part of the stream at once."""
        entity = entity_of(descriptor)
        if descriptor.kind == "image":
            return self._image_sender(descriptor, entity)
        if descriptor.kind == "tactile" and _side(descriptor):
            return self._tactile_sender(descriptor, entity)
        if descriptor.kind == "pose" and descriptor.shape[-1:] == (7,):
            return self._pose_sender(descriptor, entity)
        if descriptor.kind == "keypoints" and descriptor.shape[-1:] == (3,):
            return lambda block: self._send_points(entity, block)
        return lambda block: self._send_numbers(entity, block)

    def _send(self, entity: str, block: Block, columns: Iterable[object]) -> None:
        time = rr.TimeColumn(self._timeline, duration=block.t_ns.astype("timedelta64[ns]"))
        self.stream.send_columns(entity, [time], columns)

    def _image_sender(self, descriptor: StreamDescriptor, entity: str) -> Callable[[Block], None]:
        if descriptor.unit == "jpeg":
            return lambda block: self._send(
                entity,
                block,
                rr.EncodedImage.columns(
                    blob=list(block.values), media_type=["image/jpeg"] * len(block)
                ),
            )
        if descriptor.unit == "h264":
            self.stream.log(entity, rr.VideoStream(codec=rr.VideoCodec.H264), static=True)
            return lambda block: self._send(
                entity,
                block,
                rr.VideoStream.columns(
                    sample=list(block.values),
                    is_keyframe=[is_keyframe(unit) for unit in block.values],
                ),
            )
        if descriptor.dtype != "uint8" or descriptor.shape[2:] != (3,):
            raise InvalidInputError(
                f"{descriptor.name}: got images of {descriptor.dtype} {descriptor.shape}, "
                "expected uint8 [h, w, 3] or JPEG or H.264"
            )
        self._log_format(entity, descriptor.shape[0], descriptor.shape[1])
        return lambda block: self._send_pixels(entity, block, block.values)

    def _log_format(self, entity: str, height_px: int, width_px: int) -> None:
        kind = ImageFormat(
            width=width_px,
            height=height_px,
            color_model=rr.ColorModel.RGB,
            channel_datatype=rr.ChannelDatatype.U8,
        )
        self.stream.log(entity, rr.Image.from_fields(format=kind), static=True)

    def _send_pixels(self, entity: str, block: Block, images: np.ndarray) -> None:
        flat = np.ascontiguousarray(images).reshape(len(images), -1)
        self._send(entity, block, rr.Image.columns(buffer=flat))

    def _tactile_sender(self, descriptor: StreamDescriptor, entity: str) -> Callable[[Block], None]:
        side = _side(descriptor) or "left"
        full_scale = FULL_SCALE_KPA
        if descriptor.unit != "kPa":
            # Raw counts have no absolute scale; the strongest reading of the take is the brightest.
            largest = [block.values.max() for block in blocks(self._reader, descriptor.name)]
            full_scale = float(max(largest, default=1)) or 1.0
        picture = heat_map(np.zeros(descriptor.shape), side=side, full_scale=full_scale)
        self._log_format(entity, *picture.shape[:2])

        def send(block: Block) -> None:
            pictures = [heat_map(row, side=side, full_scale=full_scale) for row in block.values]
            self._send_pixels(entity, block, np.stack(pictures))

        return send

    def _pose_sender(self, descriptor: StreamDescriptor, entity: str) -> Callable[[Block], None]:
        if len(descriptor.shape) == 1:
            entities = [entity]
        else:
            entities = [f"{entity}/{index}" for index in range(descriptor.shape[0])]
        for each in entities:
            self.stream.log(each, rr.TransformAxes3D(AXIS_LENGTH_M), static=True)

        def send(block: Block) -> None:
            poses = block.values.reshape(len(block), -1, 7)
            for index, each in enumerate(entities):
                q_wxyz = poses[:, index, 3:]
                columns = rr.Transform3D.columns(
                    translation=poses[:, index, :3], quaternion=np.roll(q_wxyz, -1, axis=1)
                )
                self._send(each, block, columns)

        return send

    def _send_points(self, entity: str, block: Block) -> None:
        num_points = int(np.prod(block.values.shape[1:-1]))
        columns = rr.Points3D.columns(
            positions=block.values.reshape(-1, 3),
            radii=np.full(len(block) * num_points, POINT_RADIUS_M),
        )
        self._send(entity, block, columns.partition([num_points] * len(block)))

    def _send_numbers(self, entity: str, block: Block) -> None:
        rows = block.values.reshape(len(block), -1).astype(np.float64)
        columns = rr.Scalars.columns(scalars=rows.ravel())
        self._send(entity, block, columns.partition([rows.shape[1]] * len(block)))


def heat_map(row: np.ndarray, *, side: Side, full_scale: float) -> UInt8[np.ndarray, "28 26 3"]:
    """One reading of a glove as a small RGB picture of the hand.

    Args:
        row: 320 taxels or the 360 raw cells.
        side: of the hand.
        full_scale: reading shown at full brightness, in the unit of the row.
    """
    taxels = select_taxels(row, side=side) if row.shape == (NUM_RAW_TAXELS,) else row
    return colour(hand_canvas(taxels, side=side), full_scale_kpa=full_scale)


def _side(descriptor: StreamDescriptor) -> Side | None:
    """Side of a tactile stream; None if it cannot be drawn as a hand."""
    if descriptor.shape not in {(NUM_TAXELS,), (NUM_RAW_TAXELS,)}:
        return None
    if descriptor.side is not None:
        return descriptor.side
    sides: tuple[Side, Side] = ("left", "right")
    return next((side for side in sides if descriptor.name.endswith(f"_{side}")), None)


def _id_of(reader: Reader) -> str:
    if isinstance(reader, EpisodeReader):
        return reader.attributes.episode_id
    return reader.attributes.recording_id
