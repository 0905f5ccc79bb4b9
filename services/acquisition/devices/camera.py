"""Driver of a camera bridge, whose packets hold raw, JPEG or H.264 images."""

import struct
from typing import Literal

import numpy as np
from pydantic import Field

from dextouch.episodes import check_group
from dextouch.errors import CorruptDataError, DeviceError, InvalidInputError
from dextouch.images import check_jpeg, decode_jpeg
from dextouch.streams import (
    ClockCapabilities,
    Sample,
    StreamDescriptor,
    check_encoded_image,
    encoded_values,
)
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import CameraStream, DeviceKind, TcpSettings
from services.acquisition.drivers.base import Driver, StreamDecoder, check_packet
from services.acquisition.drivers.images import (
    ImageChecker,
    ImageEncoding,
    ImageQuality,
    WholeGroups,
)
from services.acquisition.drivers.packets import Packet, PacketDecoder
from services.acquisition.transports import tcp_transport

MAGIC = b"DXCI"
# height and width in pixels, encoding, three bytes of padding; then the image
PAYLOAD_HEADER = struct.Struct("<HHB3x")
ENCODING_CODES: dict[ImageEncoding, int] = {"rgb8": 0, "jpeg": 1, "h264": 2}
NOMINAL_RATE_HZ = 30.0
MAX_PAYLOAD_BYTES = 4 * 1024 * 1024
# Full size for sharpness and exposure; every image is decoded at an eighth of it anyway.
LOOK_AT_EVERY_JPEG = 10


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


class CameraDecoder(StreamDecoder[Packet]):
    """Images of one fixed size and encoding; JPEG and H.264 images stay compressed.

    Every JPEG and H.264 image is decoded on arrival, by the rule of the store's readers, which is
    also that of `dextouch store verify`: what a decoder would fill in is no image. H.264 images
    come in whole groups only, since the store takes no others. A damaged JPEG image, and a group
    that lost an image or has a damaged one, is dropped and counted as `refused`.
    """

    def __init__(
        self, stream: str, *, height_px: int, width_px: int, encoding: ImageEncoding = "rgb8"
    ) -> None:
        self._stream = stream
        self._size = (height_px, width_px)
        self._encoding: ImageEncoding = encoding
        self._descriptor = camera_descriptor(
            stream, height_px=height_px, width_px=width_px, encoding=encoding
        )
        packets = PacketDecoder(
            MAGIC, min_payload=PAYLOAD_HEADER.size + 1, max_payload=MAX_PAYLOAD_BYTES
        )
        super().__init__(self._descriptor, packets)
        self._groups = WholeGroups(stream, self.statistics)
        self._checker = ImageChecker(period_ns=self._descriptor.period_ns())
        self._num_images = 0

    @property
    def quality(self) -> ImageQuality:
        """What the images are like; of H.264 their content only."""
        return self._checker.quality

    def reset(self) -> None:
        """Forget half a packet, and a group that was begun."""
        super().reset()
        self._groups.reset()

    def feed(self, data: bytes, t_host_ns: int = 0) -> list[Sample]:
        """Images completed by `data`: uint8 [h, w, 3], or bytes as a 0-d object array.

        Raises:
            DeviceError: another version, image size, encoding or length of groups than announced.
        """
        samples = super().feed(data, t_host_ns)
        if self._encoding != "h264":
            return samples
        groups = (self._groups.add(sample) for sample in samples)
        return [whole for group in groups if self._is_undamaged(group) for whole in group]

    def _is_undamaged(self, group: list[Sample]) -> bool:
        try:
            if group:
                for picture in check_group([s.values.item() for s in group], self._size):
                    self._checker.see(picture)
        except CorruptDataError:
            self.statistics.refused += len(group)
            return False
        return True

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        check_packet(packet, device=self._stream, source=None)
        values = self._image(packet.payload)
        if values is None:
            return None
        sample = Sample(t_host_ns, values, packet.t_device_ns, packet.sequence)
        if self._encoding != "h264":
            self._look(sample)
        return sample

    def _image(self, payload: bytes) -> np.ndarray | None:
        height_px, width_px, code = PAYLOAD_HEADER.unpack_from(payload)
        if (height_px, width_px) != self._size or code != ENCODING_CODES[self._encoding]:
            raise DeviceError(
                f"{self._stream}: sends {width_px} by {height_px} px in encoding {code}, expected "
                f"{self._size[1]} by {self._size[0]} in {ENCODING_CODES[self._encoding]} "
                f"({self._encoding}); change the settings of the camera or of the station"
            )
        if self._encoding == "rgb8":
            image = self._raw(payload)
        else:
            image = self._encoded(payload[PAYLOAD_HEADER.size :])
        if image is None:
            self.statistics.refused += 1
        return image

    def _raw(self, payload: bytes) -> np.ndarray | None:
        if len(payload) - PAYLOAD_HEADER.size != self._size[0] * self._size[1] * 3:
            return None
        pixels = np.frombuffer(payload, np.uint8, offset=PAYLOAD_HEADER.size)
        return pixels.reshape(*self._size, 3)

    def _encoded(self, body: bytes) -> np.ndarray | None:
        try:
            if self._encoding == "h264":
                # Its pictures are checked when its group is complete.
                check_encoded_image(self._descriptor, body, where=self._stream)
            else:
                self._checker.see(check_jpeg(body, self._size, where=self._stream))
        except (CorruptDataError, InvalidInputError):
            return None
        return encoded_values([body]).reshape(())

    def _look(self, sample: Sample) -> None:
        if self._encoding == "rgb8":
            self._checker.check(sample.values, sample.t_device_ns)
            return
        data = sample.values.item()
        self._checker.note(data, sample.t_device_ns)
        if self._num_images % LOOK_AT_EVERY_JPEG == 0:
            self._checker.look(decode_jpeg(data, where=self._stream))
        self._num_images += 1


class CameraSettings(TcpSettings):
    """A camera bridge at a TCP address."""

    kind: Literal["camera"] = "camera"
    stream: CameraStream
    height_px: int = Field(default=480, gt=0)
    width_px: int = Field(default=640, gt=0)
    encoding: Literal["rgb8", "jpeg", "h264"] = "jpeg"


def build(settings: CameraSettings, clock: StationClock) -> Driver:
    """The driver of one bridge."""
    decoder = CameraDecoder(
        settings.stream,
        height_px=settings.height_px,
        width_px=settings.width_px,
        encoding=settings.encoding,
    )
    return Driver(
        settings.stream,
        transport=tcp_transport(settings.host, settings.port),
        decoder=decoder,
        clock=clock,
    )


KIND = DeviceKind(name="camera", settings=CameraSettings, build=build)
