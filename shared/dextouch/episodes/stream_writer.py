"""Writer of one stream of a group, and digest of what a stream of a recording holds."""

import hashlib
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from dextouch.episodes.format import (
    GOP_IMAGES,
    STAMPS,
    ArrayEntry,
    Kind,
    codec_of,
    stream_arrays,
    stream_content,
)
from dextouch.episodes.image_codecs import (
    GopEncoder,
    VideoSettings,
    check_video_size,
    is_keyframe,
    pack_chunk,
)
from dextouch.episodes.shards import ShardWriter
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, StorageError
from dextouch.images import DEFAULT_QUALITY, encode_jpeg
from dextouch.schemas import StreamContent
from dextouch.streams import SampleBatch, StreamDescriptor, check_encoded_image

MAX_WAITING_IMAGES = 32
# Images of a storage chunk.
_CHUNK_IMAGES = {"jpeg": 1, "h264": GOP_IMAGES}
Stamps = Mapping[str, np.ndarray]


class StreamWriter:
    """Writes values and stamps of one stream, after validating every block.

    Plain images of a `jpeg` or `h264` stream are encoded in a background thread.
    """

    def __init__(self, stage: Path, descriptor: StreamDescriptor, kind: Kind) -> None:
        self.descriptor, self._kind = descriptor, kind
        self._last_stamp_ns: int | None = None
        # Arrival stamps may repeat: a device can hand over several samples at once.
        self._least_step_ns = 1 if kind == "episode" else 0
        # Whether values are numbers or encoded images, decided by the first block.
        self._plain: bool | None = None
        # Whether a block was interrupted, after which arrays are misaligned.
        self._is_broken = False
        self._codec = codec_of(descriptor)
        self._dtype = descriptor.numpy_dtype()
        self._images = _EncodedImages(descriptor)
        self._queue: _ImageQueue | None = None
        entries = stream_arrays(descriptor, kind)
        self.arrays = {name: ShardWriter(stage, name, entry) for name, entry in entries.items()}

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
        if self._codec == "zstd" or (self._queue is None and values.dtype == object):
            self._write(values, stamps)
        else:
            # Once there is a queue, everything goes through it to keep the order.
            if self._queue is None:
                self._queue = _ImageQueue(self._write, name=name)
            self._queue.put(values, stamps)

    def _check_order(self, stamps_ns: np.ndarray) -> None:
        first_ns, last_ns, least = int(stamps_ns[0]), self._last_stamp_ns, self._least_step_ns
        # Compared, not subtracted: the difference of two extreme stamps can overflow.
        earlier, later = stamps_ns[:-1], stamps_ns[1:]
        wrong = later <= earlier if least else later < earlier
        if last_ns is not None and first_ns - last_ns < least:
            bad, step_ns = 0, first_ns - last_ns
        elif wrong.any():
            bad = int(wrong.argmax()) + 1
            step_ns = int(stamps_ns[bad]) - int(stamps_ns[bad - 1])
        else:
            self._last_stamp_ns = int(stamps_ns[-1])
            return
        raise InvalidInputError(
            f"{self.descriptor.name}: stamp goes from sample to sample by {step_ns} ns before "
            f"sample {bad} of this block, expected at least {least} ns; "
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
        self._is_broken = False

    def _check_unbroken(self) -> None:
        if self._is_broken:
            raise StorageError(
                f"{self.descriptor.name}: a block was interrupted, and nothing can follow it; "
                "leave the writer's context, which removes what was written, and write it again"
            )

    def finish(self) -> dict[str, ArrayEntry]:
        """Complete all arrays and return their entries of the commit record.

        Raises StorageError if a block was written partially because of a disk failure.
        """
        if self._queue is not None:
            self._queue.drain()
        self._check_unbroken()
        name = self.descriptor.name
        for payload, num_images in self._images.rest():
            self.arrays[name].append_encoded(payload, num_images)
        entries = {name: array.finish() for name, array in self.arrays.items()}
        entries[name] = entries[name].model_copy(update={"encoder": self._images.encoder})
        counts = {array: entry.shape[0] for array, entry in entries.items()}
        if len(set(counts.values())) != 1:
            raise StorageError(f"{name}: a block was written partially ({counts}); write it again")
        return entries

    def close(self) -> None:
        """Stop the thread and close the files, discarding buffered samples."""
        if self._queue is not None:
            self._queue.stop()
        for array in self.arrays.values():
            array.close()


class _EncodedImages:
    """Groups the images of a `jpeg` or `h264` stream into storage chunks."""

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._descriptor = descriptor
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
        complete = []
        for data in images:
            self._group.append(data)
            if len(self._group) == _CHUNK_IMAGES[self._codec]:
                complete += self.rest()
        return complete

    def rest(self) -> list[tuple[bytes, int]]:
        """The last, partial storage chunk."""
        group, self._group = self._group, []
        return [(pack_chunk(self._codec, group), len(group))] if group else []

    def _encode(self, image: np.ndarray) -> bytes:
        if self._codec == "jpeg":
            self.encoder = f"simplejpeg quality {DEFAULT_QUALITY}"
            return encode_jpeg(image)
        if self._video is None:
            height, width, _ = self._descriptor.shape
            rate_hz = self._descriptor.nominal_rate_hz
            self._video = GopEncoder(height, width, rate_hz=rate_hz, settings=VideoSettings())
            self.encoder = self._video.description
        return self._video.encode(image)


class _ImageQueue:
    """Writes blocks of images of a stream in order, in a background thread, with backpressure."""

    def __init__(self, write: Callable[[np.ndarray, Stamps], None], *, name: str) -> None:
        self._write = write
        self._waiting: deque[tuple[Future[None], int]] = deque()
        self._spare: deque[np.ndarray] = deque(maxlen=MAX_WAITING_IMAGES)
        self._num_images = 0
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix=f"encode-{name}")

    def put(self, values: np.ndarray, stamps: Stamps) -> None:
        """Queue a copy of a block; re-raises the exception of an earlier one."""
        while self._waiting and self._waiting[0][0].done():
            self._take_oldest()
        # A block larger than the queue is accepted when the queue is empty.
        while self._waiting and self._num_images + len(values) > MAX_WAITING_IMAGES:
            self._take_oldest()
        kept = {name: column.copy() for name, column in stamps.items()}
        work = self._thread.submit(self._hand_on, self._copy(values), kept)
        self._waiting.append((work, len(values)))
        self._num_images += len(values)

    def drain(self) -> None:
        """Wait until the queue is empty; raises as `put`."""
        while self._waiting:
            self._take_oldest()

    def stop(self) -> None:
        """End the thread and discard the queued blocks."""
        self._thread.shutdown(cancel_futures=True)

    def _copy(self, values: np.ndarray) -> np.ndarray:
        if values.dtype == object:
            return values.copy()
        # Reused buffers: page faults of fresh memory cost more than copying the image.
        while self._spare:
            spare = self._spare.pop()
            if spare.shape == values.shape:
                np.copyto(spare, values)
                return spare
        return values.copy()

    def _hand_on(self, values: np.ndarray, stamps: Stamps) -> None:
        self._write(values, stamps)
        if values.dtype != object:
            self._spare.append(values)

    def _take_oldest(self) -> None:
        done, num_images = self._waiting.popleft()
        self._num_images -= num_images
        done.result()


class ContentDigest:
    """Digest of the samples of one stream of a recording, batch by batch.

    By it a station proves that a recording has all of its take: it is made of what a commit record
    says of the stream (`stream_content`), and a station computes it from its spool.
    Images of `jpeg` and `h264` streams are encoded, as in a spool.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._codec = codec_of(descriptor)
        self._dtype = descriptor.numpy_dtype().newbyteorder("<")
        # As in `stream_arrays`: values first.
        self._columns = [hashlib.sha256() for _ in range(1 + len(STAMPS["recording"]))]
        self._group: list[bytes] = []
        self._num_samples = 0

    def add(self, batch: SampleBatch) -> None:
        """Add the next samples of the stream."""
        values, *stamps = self._columns
        self._num_samples += len(batch)
        for column, stamp in zip(stamps, STAMPS["recording"], strict=True):
            column.update(getattr(batch, stamp).astype("<i8").tobytes())
        if self._codec == "zstd":
            values.update(batch.values.astype(self._dtype, order="C", copy=False).data)
            return
        for image in batch.values:
            self._group.append(image)
            if len(self._group) == _CHUNK_IMAGES[self._codec]:
                values.update(pack_chunk(self._codec, self._group))
                self._group = []

    def content(self) -> StreamContent:
        """What was added so far."""
        values, *stamps = (column.copy() for column in self._columns)
        if self._group:
            values.update(pack_chunk(self._codec, self._group))
        return stream_content(self._num_samples, [c.hexdigest() for c in (values, *stamps)])
