"""Streams of an episode under construction, whose samples are produced while it is written.

Images of `jpeg` and `h264` streams go over as the bytes that they are: nothing is decoded.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from dextouch.episodes import GOP_IMAGES
from dextouch.streams import ENCODED_UNITS, H264_UNIT, StreamDescriptor, encoded_values
from services.alignment.synchronization.recorded_streams import Block, DatedStream
from services.alignment.synchronization.resampling import EDGE_PERIODS

# Encoded images that are in memory at once, a multiple of a group of pictures.
IMAGES_AT_ONCE = 8 * GOP_IMAGES


@dataclass
class EpisodeStream:
    """One stream of an episode, whose samples are produced while they are written.

    `blocks` are in order, with times of the episode; `quality` is complete when all were taken.
    """

    descriptor: StreamDescriptor
    blocks: Iterator[Block]
    quality: dict[str, float] = field(default_factory=dict)


def cut_stream(stream: DatedStream, origin_ns: int, last_ns: int) -> EpisodeStream:
    """The samples of the episode's time, with the neighbours that its ends need.

    `origin_ns` is the host time of the episode's time 0; `last_ns`, of the last step, counts from
    there.
    """
    margin_ns = round(EDGE_PERIODS * stream.descriptor.period_ns())
    edges_ns = [origin_ns - margin_ns, origin_ns + last_ns + margin_ns]
    first = int(np.searchsorted(stream.t_ns, edges_ns[0], side="left"))
    stop = int(np.searchsorted(stream.t_ns, edges_ns[1], side="right"))
    quality: dict[str, float] = {}
    if stream.descriptor.unit not in ENCODED_UNITS:
        source = _complete_blocks(stream, (first, stop), quality)
    else:
        source = _image_blocks(stream, first, stop, quality)
    blocks = (Block(block.t_ns - origin_ns, block.values) for block in source)
    return EpisodeStream(stream.descriptor, blocks, quality)


def _complete_blocks(
    stream: DatedStream, inside: tuple[int, int], quality: dict[str, float]
) -> Iterator[Block]:
    """Samples inside without NaN or infinity; those of the whole recording that have some count."""
    can_miss = stream.descriptor.numpy_dtype().kind == "f"
    num_incomplete, index = 0, 0
    first, stop = (0, len(stream.t_ns)) if can_miss else inside
    for piece in stream.pieces(first, stop):
        values, t_ns = piece.values, piece.t_ns
        numbers = np.arange(first + index, first + index + len(t_ns))
        index += len(t_ns)
        taken = (numbers >= inside[0]) & (numbers < inside[1])
        if can_miss:
            whole = np.isfinite(values).reshape(len(values), -1).all(axis=1)
            num_incomplete += int((~whole).sum())
            taken &= whole
        if taken.all():
            yield piece
        elif taken.any():
            yield Block(t_ns[taken], values[taken])
    if num_incomplete:
        quality[f"{stream.name}_num_incomplete"] = float(num_incomplete)


def _image_blocks(
    stream: DatedStream, first: int, stop: int, quality: dict[str, float]
) -> Iterator[Block]:
    kept = stream.timing.kept
    if stop <= first:
        return
    if stream.descriptor.unit == H264_UNIT:
        # A group of pictures goes over whole: the images before the first one that is needed too.
        first = max(0, first - int(kept[first]) % GOP_IMAGES)
        begins_group = int(kept[first]) % GOP_IMAGES == 0
        if not begins_group or int(kept[stop - 1] - kept[first]) != stop - 1 - first:
            # Images without a timestamp are in between: the rest is not a complete group.
            quality[f"{stream.name}_num_images_encoded_anew"] = float(stop - first)
            yield from stream.pieces(first, stop)
            return
    for low in range(first, stop, IMAGES_AT_ONCE):
        part = kept[low : min(low + IMAGES_AT_ONCE, stop)]
        start = int(part[0])
        images = stream.recording.encoded_images(stream.name, start, int(part[-1]) + 1)
        chosen = [images[number] for number in (part - start).tolist()]
        yield Block(stream.t_ns[low : low + len(part)], encoded_values(chosen))
