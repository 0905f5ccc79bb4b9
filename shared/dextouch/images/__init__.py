"""JPEG encoding of still images."""

from dextouch.images.jpeg import DEFAULT_QUALITY, decode_jpeg, encode_jpeg, jpeg_size

__all__ = [
    "DEFAULT_QUALITY",
    "decode_jpeg",
    "encode_jpeg",
    "jpeg_size",
]
