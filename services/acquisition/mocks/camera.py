"""Images of one camera come in; a camera bridge's packets, raw or JPEG, go out."""

import numpy as np
from jaxtyping import Int64

from dextouch.images.jpeg import encode_jpeg
from services.acquisition.drivers.camera import (
    ENCODING_CODES,
    MAGIC,
    PAYLOAD_HEADER,
    ImageEncoding,
)
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.mocks.replay import ReplayStream


class CameraSource:
    """Packets of one camera.

    Args:
        stream: uint8 [n, h, w, 3].
        encoding: of the images on the wire.
    """

    def __init__(self, stream: ReplayStream, *, encoding: ImageEncoding = "rgb8") -> None:
        self._stream = stream
        self._encoding: ImageEncoding = encoding

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self._stream.t_ns

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        image = self._stream.values[index]
        header = PAYLOAD_HEADER.pack(*image.shape[:2], ENCODING_CODES[self._encoding])
        body = image.tobytes() if self._encoding == "rgb8" else encode_jpeg(image)
        packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, header + body)
        return [encode_packet(MAGIC, packet)]
