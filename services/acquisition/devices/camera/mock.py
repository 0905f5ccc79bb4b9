"""A simulated camera bridge that sends raw, JPEG or H.264 images."""

from services.acquisition.devices.camera.driver import ENCODING_CODES, MAGIC, PAYLOAD_HEADER
from services.acquisition.drivers.image_encoding import ImageEncoder, ImageEncoding
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.mocks.replay import PacketSource, ReplayStream


class CameraSource(PacketSource):
    """Packets of one camera.

    Args:
        stream: uint8 [n, h, w, 3].
        encoding: of the images on the wire.
    """

    def __init__(self, stream: ReplayStream, *, encoding: ImageEncoding = "rgb8") -> None:
        self.t_ns = stream.t_ns
        self._images = stream.values
        self._encoding: ImageEncoding = encoding
        height_px, width_px = stream.descriptor.shape[:2]
        self._encoder = ImageEncoder(
            encoding, (height_px, width_px), rate_hz=stream.descriptor.nominal_rate_hz
        )
        self._last_sequence: int | None = None

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        image = self._images[index]
        header = PAYLOAD_HEADER.pack(*image.shape[:2], ENCODING_CODES[self._encoding])
        body = image.tobytes() if self._encoding == "rgb8" else self._encoded(index, sequence)
        packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, header + body)
        return [encode_packet(MAGIC, packet)]

    def _encoded(self, index: int, sequence: int) -> bytes:
        # Packets that get lost were encoded too: a lost H.264 image tears its group.
        first = sequence if self._last_sequence is None else self._last_sequence + 1
        data = b""
        for number in range(max(first, sequence - index), sequence + 1):
            image = self._images[index - (sequence - number)]
            data = self._encoder.encode(image, begins=False).item()
        self._last_sequence = sequence
        return data
