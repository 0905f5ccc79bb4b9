"""Writer of one stream of a group: validates blocks, encodes images, appends to the arrays."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dextouch.episodes.format import (
    GOP_IMAGES,
    STAMPS,
    ArrayEntry,
    Kind,
    codec_of,
    stream_arrays,
)
from dextouch.episodes.image_codecs import pack_chunk
from dextouch.episodes.image_queue import ImageQueue
from dextouch.episodes.shard_writer import ShardWriter
from dextouch.episodes.video import GopEncoder, VideoSettings, check_video_size, is_keyframe
from dextouch.episodes.write_options import WriteOptions
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, StorageError
from dextouch.images import DEFAULT_QUALITY, encode_jpeg
from dextouch.streams import StreamDescriptor, check_encoded_image

Stamps = Mapping[str, np.ndarray]


class StreamWriter:
    """Writes values and stamps of one stream, after validating every block.

    Plain images of a `jpeg` or `h264` stream are encoded in a background thread.
    """

    def __init__(
        self, stage: Path, descriptor: StreamDescriptor, kind: Kind, options: WriteOptions
    ) -> None:
        self.descriptor, self._kind, self._options = descriptor, kind, options
        self._last_stamp_ns: int | None = None
        # Arrival stamps may repeat: a device can hand over several samples at once.
        self._least_step_ns = 1 if kind == "episode" else 0
        # Whether values are numbers or encoded images, decided by the first block.
        self._plain: bool | None = None
        # Whether a block was interrupted, after which arrays are misaligned; and the number of
        # samples of all blocks before it.
        self._is_broken = False
        self._num_whole = 0
        self._codec = codec_of(descriptor)
        self._dtype = descriptor.numpy_dtype()
        self._images = _EncodedImages(descriptor, options.video)
        self._queue: ImageQueue | None = None
        entries = stream_arrays(descriptor, kind)
        self.arrays = {
            name: ShardWriter(stage, name, entry, sync=options.sync)
            for name, entry in entries.items()
        }

    @property
    def num_dropped(self) -> int:
        """Number of images dropped because the queue was full."""
        return 0 if self._queue is None else self._queue.num_dropped

    def append(self, values: np.ndarray, stamps: Stamps) -> None:
        """Append a block with all stamps of the kind; raises as `EpisodeWriter.append`."""
        name = self.descriptor.name
        for stamp, column in stamps.items():
            if column.dtype != np.int64 or column.shape != (len(values),):
                raise ShapeError(
                    f"{name}: {stamp} is {column.dtype} {column.shape}, expected int64 "
                    f"[{len(values)}] like the values"
                )
        if not len(values):
            return
        # All checks come before the first write, so that a refused block has no effect.
        plain = self._codec == "zstd" or values.dtype != object
        if self._plain is not None and self._plain != plain:
            raise InvalidInputError(
                f"{name}: got {'plain' if plain else 'encoded'} images after "
                f"{'encoded' if plain else 'plain'} ones, expected one kind in a stream"
            )
        if plain:
            self._check_values(values)
        else:
            self._images.check(values)
        self._check_order(stamps[STAMPS[self._kind][0]])
        self._plain = plain
        if self._codec == "zstd" or (
            self._queue is None and (values.dtype == object or not self._options.threads)
        ):
            self._write(values, stamps)
        else:
            self._enqueue(values, stamps)

    def _enqueue(self, values: np.ndarray, stamps: Stamps) -> None:
        # Once there is a queue, everything goes through it to keep the order.
        if self._queue is None:
            name, when_full = self.descriptor.name, self._options.when_full
            self._queue = ImageQueue(self._write, name=name, when_full=when_full)
        self._queue.put(values, stamps)

    def _check_order(self, stamps_ns: np.ndarray) -> None:
        least, first_ns, last_ns = self._least_step_ns, int(stamps_ns[0]), self._last_stamp_ns
        if last_ns is not None and first_ns - last_ns < least:
            raise self._disorder(first_ns - last_ns, 0)
        # Compared, not subtracted: the difference of two extreme stamps can overflow.
        earlier, later = stamps_ns[:-1], stamps_ns[1:]
        wrong = later <= earlier if least else later < earlier
        if wrong.any():
            bad = int(wrong.argmax())
            raise self._disorder(int(later[bad]) - int(earlier[bad]), bad + 1)
        self._last_stamp_ns = int(stamps_ns[-1])

    def _disorder(self, step_ns: int, place: int) -> InvalidInputError:
        return InvalidInputError(
            f"{self.descriptor.name}: stamp goes from sample to sample by {step_ns} ns before "
            f"sample {place} of this block, expected at least {self._least_step_ns} ns; "
            "sort the samples or drop the repeated ones"
        )

    def _check_values(self, values: np.ndarray) -> None:
        descriptor = self.descriptor
        if values.dtype != self._dtype or values.shape[1:] != descriptor.shape:
            raise ShapeError(
                f"{descriptor.name}: got values {values.dtype} {values.shape}, expected "
                f"{descriptor.dtype} [n, {', '.join(map(str, descriptor.shape))}]"
            )
        # Recordings keep raw device values; consumers of episodes do not expect NaN.
        if self._kind == "episode" and values.dtype.kind == "f" and not np.isfinite(values).all():
            raise NonFiniteError(
                f"{descriptor.name}: {int((~np.isfinite(values)).sum())} values are NaN or "
                "infinite; leave invalid samples out of an episode"
            )

    def _write(self, values: np.ndarray, stamps: Stamps) -> None:
        """Append a validated block to all arrays of the stream."""
        self._check_unbroken()
        self._is_broken = True
        array = self.arrays[self.descriptor.name]
        if self._codec == "zstd":
            array.append(values)
        else:
            for payload, num_images in self._images.chunks(values):
                array.append_encoded(payload, num_images)
        for stamp, column in stamps.items():
            self.arrays[f"{self.descriptor.name}_{stamp}"].append(column)
        self._num_whole += len(values)
        self._is_broken = False

    def _check_unbroken(self) -> None:
        if self._is_broken:
            raise StorageError(
                f"{self.descriptor.name}: a block was interrupted, and nothing can follow it; "
                "leave the writer's context, which keeps or removes the blocks before it"
            )

    def finish(self) -> dict[str, ArrayEntry]:
        """Complete all arrays and return their entries of the commit record.

        Raises:
            StorageError: a block was written partially because of a disk failure.
        """
        if self._queue is not None:
            self._queue.drain()
        self._check_unbroken()
        self._flush()
        name = self.descriptor.name
        entries = {name: array.finish() for name, array in self.arrays.items()}
        entries[name] = entries[name].model_copy(update={"encoder": self._images.encoder})
        counts = {array: entry.shape[0] for array, entry in entries.items()}
        if len(set(counts.values())) != 1:
            raise StorageError(f"{name}: a block was written partially ({counts}); write it again")
        return entries

    def _flush(self) -> None:
        """Write the last, partial storage chunks; nothing may be appended afterwards."""
        for payload, num_images in self._images.rest():
            self.arrays[self.descriptor.name].append_encoded(payload, num_images)
        for array in self.arrays.values():
            array.flush()

    def keep(self) -> None:
        """Write all buffered samples, except those of an interrupted block, and close the files.

        Raises:
            StorageError: a disk failure; earlier data is kept.
        """
        try:
            if self._queue is not None:
                self._queue.stop(drop=False)
            if not self._is_broken:
                self._flush()
            else:
                for array in self.arrays.values():
                    array.flush_until(self._num_whole)
        finally:
            self.close()

    def close(self) -> None:
        """Stop the thread and close the files, discarding buffered samples."""
        if self._queue is not None:
            self._queue.stop(drop=True)
        for array in self.arrays.values():
            array.close()


class _EncodedImages:
    """Groups the images of a `jpeg` or `h264` stream into storage chunks."""

    def __init__(self, descriptor: StreamDescriptor, settings: VideoSettings) -> None:
        self._descriptor, self._settings = descriptor, settings
        self._codec = codec_of(descriptor)
        self._num_given = 0
        self._video: GopEncoder | None = None
        self._group: list[bytes] = []
        self.encoder: str | None = None
        if self._codec == "h264":
            check_video_size(*descriptor.shape[:2])

    def check(self, values: np.ndarray) -> None:
        """Refuse encoded images that do not belong to this stream."""
        name = self._descriptor.name
        for index, data in enumerate(values):
            number = self._num_given + index
            where = f"{name}: image {number}"
            check_encoded_image(self._descriptor, data, where=where)
            begins = number % GOP_IMAGES == 0
            if self._codec == "h264" and is_keyframe(data) != begins:
                raise InvalidInputError(
                    f"{where}: is {'no' if begins else 'a'} key frame; expected closed groups of "
                    f"{GOP_IMAGES} images, each beginning with one; decode and encode it again"
                )
        self._num_given += len(values)

    def chunks(self, values: np.ndarray) -> list[tuple[bytes, int]]:
        """Add images; returns the completed storage chunks with their number of images."""
        images = list(values) if values.dtype == object else [self._encode(v) for v in values]
        if self._codec == "jpeg":
            return [(pack_chunk("jpeg", [data]), 1) for data in images]
        complete = []
        for data in images:
            self._group.append(data)
            if len(self._group) == GOP_IMAGES:
                complete += self.rest()
        return complete

    def rest(self) -> list[tuple[bytes, int]]:
        """The last, partial storage chunk."""
        group, self._group = self._group, []
        return [(pack_chunk("h264", group), len(group))] if group else []

    def _encode(self, image: np.ndarray) -> bytes:
        if self._codec == "jpeg":
            self.encoder = f"simplejpeg quality {DEFAULT_QUALITY}"
            return encode_jpeg(image)
        if self._video is None:
            height, width, _ = self._descriptor.shape
            rate_hz = self._descriptor.nominal_rate_hz
            self._video = GopEncoder(height, width, rate_hz=rate_hz, settings=self._settings)
            self.encoder = self._video.description
        return self._video.encode(image)
