"""Sensor streams: samples, stream descriptors, and the binary encoding of batches."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.streams.checks import (
        ENCODED_UNITS,
        H264_UNIT,
        JPEG_UNIT,
        check_batch,
        check_encoded_image,
        check_follows,
    )
    from dextouch.streams.descriptors import (
        MAX_STREAMS,
        ClockCapabilities,
        StreamDescriptor,
        StreamKind,
    )
    from dextouch.streams.packing import pack, unpack
    from dextouch.streams.samples import (
        NO_DEVICE_TIME,
        NO_SEQUENCE,
        Sample,
        SampleBatch,
        encoded_values,
    )
    from dextouch.streams.wire import MAX_BATCH_BYTES, decode_batch, encode_batch
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "checks": (
                "ENCODED_UNITS H264_UNIT JPEG_UNIT check_batch check_encoded_image check_follows"
            ),
            "descriptors": "ClockCapabilities MAX_STREAMS StreamDescriptor StreamKind",
            "packing": "pack unpack",
            "samples": "NO_DEVICE_TIME NO_SEQUENCE Sample SampleBatch encoded_values",
            "wire": "MAX_BATCH_BYTES decode_batch encode_batch",
        },
    )

__all__ = [
    "ENCODED_UNITS",
    "H264_UNIT",
    "JPEG_UNIT",
    "MAX_BATCH_BYTES",
    "MAX_STREAMS",
    "NO_DEVICE_TIME",
    "NO_SEQUENCE",
    "ClockCapabilities",
    "Sample",
    "SampleBatch",
    "StreamDescriptor",
    "StreamKind",
    "check_batch",
    "check_encoded_image",
    "check_follows",
    "decode_batch",
    "encode_batch",
    "encoded_values",
    "pack",
    "unpack",
]
