"""Sensor streams: samples, stream descriptors, and the binary encoding of batches."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.streams.batch import MAX_BATCH_BYTES as MAX_BATCH_BYTES
    from dextouch.streams.batch import EncodedBatch as EncodedBatch
    from dextouch.streams.batch import decode_batch as decode_batch
    from dextouch.streams.batch import decode_body as decode_body
    from dextouch.streams.batch import encode_batch as encode_batch
    from dextouch.streams.batch import encode_body as encode_body
    from dextouch.streams.batch import encode_samples as encode_samples
    from dextouch.streams.batch import frame_body as frame_body
    from dextouch.streams.batch import read_batch as read_batch
    from dextouch.streams.batch import sample_ends as sample_ends
    from dextouch.streams.limits import LEAST_SHARE_KEPT as LEAST_SHARE_KEPT
    from dextouch.streams.limits import RATE_ERROR as RATE_ERROR
    from dextouch.streams.limits import RATE_WARN as RATE_WARN
    from dextouch.streams.limits import RESIDUAL_ERROR_S as RESIDUAL_ERROR_S
    from dextouch.streams.limits import RESIDUAL_WARN_S as RESIDUAL_WARN_S
    from dextouch.streams.limits import residual_limits_s as residual_limits_s
    from dextouch.streams.openpi import pack_openpi as pack_openpi
    from dextouch.streams.openpi import unpack_openpi as unpack_openpi
    from dextouch.streams.packing import pack as pack
    from dextouch.streams.packing import unpack as unpack
    from dextouch.streams.samples import ENCODED_UNITS as ENCODED_UNITS
    from dextouch.streams.samples import H264_UNIT as H264_UNIT
    from dextouch.streams.samples import HEAD_CAMERA as HEAD_CAMERA
    from dextouch.streams.samples import JPEG_UNIT as JPEG_UNIT
    from dextouch.streams.samples import MAX_STREAMS as MAX_STREAMS
    from dextouch.streams.samples import NO_DEVICE_TIME as NO_DEVICE_TIME
    from dextouch.streams.samples import NO_SEQUENCE as NO_SEQUENCE
    from dextouch.streams.samples import ClockCapabilities as ClockCapabilities
    from dextouch.streams.samples import Sample as Sample
    from dextouch.streams.samples import SampleBatch as SampleBatch
    from dextouch.streams.samples import StreamDescriptor as StreamDescriptor
    from dextouch.streams.samples import StreamKind as StreamKind
    from dextouch.streams.samples import check_batch as check_batch
    from dextouch.streams.samples import check_encoded_image as check_encoded_image
    from dextouch.streams.samples import check_follows as check_follows
    from dextouch.streams.samples import encoded_values as encoded_values
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
