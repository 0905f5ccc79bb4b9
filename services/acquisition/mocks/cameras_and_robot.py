"""Simulated cameras, behind a bridge and on the station's own bus, and a robot's state server."""

import struct
from collections.abc import Mapping

import numpy as np

from dextouch.errors import DeviceError, InvalidInputError
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.devices import camera, robot_state, station_camera
from services.acquisition.drivers.images import ImageEncoder, ImageEncoding
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.mocks import replay
from services.acquisition.mocks.ports import ReportPort

UNIT_HEADER = struct.Struct("<qHH")
# With a virtual clock, time must not go on while an image is being encoded.
LOCKSTEP_WAIT_S = 20.0


class CameraSource(replay.PacketSource):
    """Packets of one camera, of a stream uint8 [n, h, w, 3]."""

    def __init__(self, stream: replay.ReplayStream, *, encoding: ImageEncoding = "rgb8") -> None:
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
        header = camera.PAYLOAD_HEADER.pack(*image.shape[:2], camera.ENCODING_CODES[self._encoding])
        body = image.tobytes() if self._encoding == "rgb8" else self._encoded(index, sequence)
        packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, header + body)
        return [encode_packet(camera.MAGIC, packet)]

    def _encoded(self, index: int, sequence: int) -> bytes:
        # Packets that get lost were encoded too: a lost H.264 image tears its group.
        first = sequence if self._last_sequence is None else self._last_sequence + 1
        data = b""
        for number in range(max(first, sequence - index), sequence + 1):
            image = self._images[index - (sequence - number)]
            data = self._encoder.encode(image, begins=False).item()
        self._last_sequence = sequence
        return data


class VideoPort(ReportPort):
    """The device's end of a camera; each opening of the host gets a new capture."""

    # V4L2 drivers fill their buffers and lose later images.
    max_reports = 4
    transport: "MockCapture"

    def __init__(self, name: str) -> None:
        super().__init__()
        # What the camera states, if anything.
        self.exposure_ns: int | None = None
        self.transport = MockCapture(self, name)


class MockCapture(station_camera.CaptureLink[VideoPort]):
    """The host's end of a mock camera."""

    def __init__(self, port: VideoPort, name: str) -> None:
        super().__init__(address=f"mock:{name}", serial_number=name)
        self._port = port
        self._unit = b""

    def wait(self, timeout_s: float) -> bool:
        """Fetch the next image; images fetched before have been processed by now."""
        port = self._opened()
        port.link.add_consumed(len(self._unit))
        try:
            self._unit = port.fetch(timeout_s)
        except OSError as error:
            raise DeviceError(f"{self.info}: unplugged while reading") from error
        return bool(self._unit)

    def retrieve(self) -> station_camera.CapturedImage | None:
        """The image fetched."""
        t_driver_ns, height_px, width_px = UNIT_HEADER.unpack_from(self._unit)
        pixels = np.frombuffer(self._unit, dtype=np.uint8, offset=UNIT_HEADER.size)
        if pixels.size != height_px * width_px * 3:
            return None
        return station_camera.CapturedImage(pixels.reshape(height_px, width_px, 3), t_driver_ns)

    def _connect(self) -> VideoPort:
        port = self._port
        port.check_plugged()
        port.flush()
        port.link.set_open(is_open=True)
        self.exposure_ns, self._unit = port.exposure_ns, b""
        return port

    def _release(self, handle: VideoPort) -> None:
        handle.link.set_open(is_open=False)


class VideoSource(replay.PacketSource):
    """Images, uint8 [n, h, w, 3], with the stamps of the kernel."""

    def __init__(self, stream: replay.ReplayStream) -> None:
        self.t_ns = stream.t_ns
        self._images = stream.values

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One image; cameras have no sequence."""
        image = self._images[index]
        return [UNIT_HEADER.pack(t_device_ns, *image.shape[:2]) + image.tobytes()]


class VideoDevice(replay.MockDevice):
    """A mock device whose clock is the host's, since the host's kernel stamps its images."""

    def play(
        self, clock: StationClock, waiter: Waiter, *, start_host_ns: int, offset_ns: int = 0
    ) -> bool:
        """Play the whole source once, as every mock device does."""
        self._boot_ns = start_host_ns
        return super().play(clock, waiter, start_host_ns=start_host_ns, offset_ns=offset_ns)


def video_camera(place: replay.MockSlot, **settings: float | str) -> replay.MockPair:
    """A mock camera that plays a stream of images, and its driver with other settings."""
    port, descriptor = VideoPort(place.name), place.stream.descriptor
    known = {
        "stream": place.name,
        "rate_hz": descriptor.nominal_rate_hz,
        "height_px": descriptor.shape[0],
        "width_px": descriptor.shape[1],
    }
    driver = station_camera.StationCamera(
        station_camera.StationCameraSettings.model_validate({**known, **settings}),
        link=port.transport,
        clock=place.clock,
        max_encode_wait_s=LOCKSTEP_WAIT_S,
    )
    return replay.MockPair(VideoDevice(place, VideoSource(place.stream), port), driver)


class RobotStateSource(replay.PacketSource):
    """Packets of one robot, of the six streams of `STREAM_SIZES`, all with the same times.

    Raises:
        InvalidInputError: one is missing, or their times differ.
    """

    def __init__(self, streams: Mapping[str, replay.ReplayStream]) -> None:
        missing = sorted(set(robot_state.STREAM_SIZES) - set(streams))
        if missing:
            raise InvalidInputError(f"robot state: streams {missing} are missing")
        parts = [streams[name] for name in robot_state.STREAM_SIZES]
        if any(not np.array_equal(part.t_ns, parts[0].t_ns) for part in parts):
            raise InvalidInputError("robot state: the six streams have different times")
        self.t_ns = parts[0].t_ns
        self._numbers = np.concatenate([part.values for part in parts], axis=1).astype("<f8")

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        payload = self._numbers[index].tobytes()
        packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, payload)
        return [encode_packet(robot_state.MAGIC, packet)]
