"""Camera bridge over a socket: packets with raw or JPEG images come in, images go out."""

import struct
from typing import Literal

import numpy as np

from dextouch.errors import CorruptDataError, DeviceError
from dextouch.images.jpeg import jpeg_size
from dextouch.streams.descriptors import ClockCapabilities, StreamDescriptor
from dextouch.streams.samples import Sample, encoded_values
from services.acquisition.drivers.base import Readings, check_packet
from services.acquisition.drivers.packets import DecoderStatistics, PacketDecoder

MAGIC = b"DXCI"
# height and width in pixels, encoding, three bytes of padding; then the image
PAYLOAD_HEADER = struct.Struct("<HHB3x")
ImageEncoding = Literal["rgb8", "jpeg"]
ENCODING_CODES: dict[ImageEncoding, int] = {"rgb8": 0, "jpeg": 1}
NOMINAL_RATE_HZ = 30.0
MAX_PAYLOAD_BYTES = 4 * 1024 * 1024


def camera_descriptor(
    stream: str, *, height_px: int, width_px: int, encoding: ImageEncoding
) -> StreamDescriptor:
    """The image stream of one camera: unit `rgb8` for raw images, `jpeg` for JPEG bytes."""
    return StreamDescriptor(
        name=stream,
        kind="image",
        shape=(height_px, width_px, 3),
        dtype="uint8",
        unit=encoding,
        nominal_rate_hz=NOMINAL_RATE_HZ,
        frame=stream,
        device=stream,
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


class CameraDecoder:
    """Images of one fixed size and encoding; JPEG images stay compressed (readers decode)."""

    def __init__(
        self, stream: str, *, height_px: int, width_px: int, encoding: ImageEncoding = "rgb8"
    ) -> None:
        self._stream = stream
        self._size = (height_px, width_px)
        self._encoding: ImageEncoding = encoding
        self._packets = PacketDecoder(
            MAGIC, min_payload=PAYLOAD_HEADER.size + 1, max_payload=MAX_PAYLOAD_BYTES
        )

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far; `refused` counts images that are no images."""
        return self._packets.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The image stream."""
        return (
            camera_descriptor(
                self._stream,
                height_px=self._size[0],
                width_px=self._size[1],
                encoding=self._encoding,
            ),
        )

    def reset(self) -> None:
        """Forget half a packet."""
        self._packets.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Images completed by `data`: uint8 [h, w, 3], or JPEG bytes as a 0-d object array.

        Raises:
            DeviceError: another version, image size or encoding than announced.
        """
        samples = []
        for packet in self._packets.feed(data):
            check_packet(packet, device=self._stream, source=None)
            image = self._image(packet.payload)
            if image is not None:
                samples.append(Sample(t_host_ns, image, packet.t_device_ns, packet.sequence))
        return {self._stream: samples} if samples else {}

    def _image(self, payload: bytes) -> np.ndarray | None:
        height_px, width_px, code = PAYLOAD_HEADER.unpack_from(payload)
        if (height_px, width_px) != self._size or code != ENCODING_CODES[self._encoding]:
            raise DeviceError(
                f"{self._stream}: sends {width_px} by {height_px} px in encoding {code}, expected "
                f"{self._size[1]} by {self._size[0]} in {ENCODING_CODES[self._encoding]} "
                f"({self._encoding}); set the camera or the station"
            )
        body = payload[PAYLOAD_HEADER.size :]
        image = self._raw(body) if self._encoding == "rgb8" else self._jpeg(body)
        if image is None:
            self.statistics.refused += 1
        return image

    def _raw(self, body: bytes) -> np.ndarray | None:
        if len(body) != self._size[0] * self._size[1] * 3:
            return None
        return np.frombuffer(body, dtype=np.uint8).reshape(*self._size, 3)

    def _jpeg(self, body: bytes) -> np.ndarray | None:
        try:
            if jpeg_size(body, where=self._stream) != self._size:
                return None
        except CorruptDataError:
            return None
        return encoded_values([body]).reshape(())
