"""The simulated devices of a mock station, made to play the streams of an episode."""

from collections.abc import Mapping, Sequence

from dextouch.errors import InvalidInputError
from dextouch.schemas import Matrix
from dextouch.tactile.layout import SIDES, Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.camera.driver import CameraDecoder, CameraDriver
from services.acquisition.devices.camera.mock import CameraSource
from services.acquisition.devices.finger_tracker.mock import mock_finger_tracker
from services.acquisition.devices.mocking import mock_of
from services.acquisition.devices.pose_tracker.mock import mock_pose_tracker
from services.acquisition.devices.robot_state.mock import RobotStateSource
from services.acquisition.devices.robot_state.packets import STREAM_SIZES, RobotStateDecoder
from services.acquisition.devices.station_camera.mock import video_camera
from services.acquisition.drivers.base import Driver
from services.acquisition.mock_links import MockLinks
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pair import MockPair
from services.acquisition.mocks.place import MockPlace
from services.acquisition.mocks.ports import MockPort, SocketPort
from services.acquisition.mocks.replay import (
    MockDevice,
    PacketSource,
    ReplayStream,
    device_rng,
)
from services.acquisition.mocks.tracker_place import TrackerPlace

LATENCY_SIGMA_MS = 0.2
WRISTS = ("wrist_left", "wrist_right")


class MockFactory:
    """Builds the devices that a set of streams needs.

    Args:
        streams: of one episode; streams with ground truth only are omitted.
        faults: what disturbs the devices.
        seed: of noise, calibration and faults.
        clock: of the station.
        links: how the devices are connected, and their protocols.
    """

    def __init__(
        self,
        streams: Sequence[ReplayStream],
        *,
        faults: FaultScript,
        seed: int,
        clock: StationClock,
        links: MockLinks | None = None,
    ) -> None:
        self._streams = {stream.descriptor.name: stream for stream in streams}
        if len(self._streams) != len(streams):
            raise InvalidInputError("mock station: two streams of the same name")
        self._faults = faults
        self._seed = seed
        self._clock = clock
        self._links = links or MockLinks()
        self._make_glove = mock_of(self._links.gloves)

    def build(self) -> list[MockPair]:
        """One pair a device.

        Raises:
            InvalidInputError: no stream that any device sends.
        """
        pairs = [pair for side in SIDES for pair in self._hand(side)]
        if "joints_measured" in self._streams:
            parts = {name: s for name, s in self._streams.items() if name in STREAM_SIZES}
            port, decoder = SocketPort("robot"), RobotStateDecoder(self._robot_streams())
            driver = Driver(
                "robot_state", transport=port.transport, decoder=decoder, clock=self._clock
            )
            device = self._device("robot_state", RobotStateSource(parts), port)
            pairs.append(MockPair(device, driver))
            trackers = ["head", *(name for name in WRISTS if name not in self._robot_streams())]
        else:
            trackers = [*WRISTS, "head"]
        pairs += [
            mock_pose_tracker(self._streams[name], self._place(f"pose_tracker_{name}"))
            for name in trackers
            if name in self._streams
        ]
        pairs += [self._camera(name) for name in self._streams if name.startswith("camera_")]
        if not pairs:
            raise InvalidInputError(
                f"mock station: got streams {sorted(self._streams)}, expected tactile_…, "
                "keypoints_…, wrist_…, head, camera_… or joints_…"
            )
        return pairs

    def _robot_streams(self) -> list[str]:
        by_trackers = self._links.wrists == "trackers"
        return [name for name in STREAM_SIZES if not (by_trackers and name in WRISTS)]

    def calibration(self, pairs: Sequence[MockPair]) -> dict[str, Matrix]:
        """What a calibrated station knows of these devices, as each of them says."""
        return {name: matrix for pair in pairs for name, matrix in pair.calibration.items()}

    def latencies(self, pairs: Sequence[MockPair]) -> dict[str, Matrix]:
        """Path delay of each stream, wrong by about its sigma as a measured one would be."""
        record: dict[str, Matrix] = {}
        for pair in pairs:
            rng = device_rng(self._seed, f"latency_{pair.device.name}")
            faults = self._faults.of(pair.device.name)
            error_ms = LATENCY_SIGMA_MS * rng.standard_normal() if faults.path_delay_ms else 0.0
            measured_ns = round(max(0.0, faults.path_delay_ms + error_ms) * 1e6)
            for descriptor in pair.driver.descriptors:
                sigma_ns = LATENCY_SIGMA_MS * 1e6
                record[f"{descriptor.name}_latency_ns"] = ((float(measured_ns),),)
                record[f"{descriptor.name}_latency_sigma_ns"] = ((sigma_ns,),)
        return record

    def _hand(self, side: Side) -> list[MockPair]:
        pairs = []
        if f"tactile_{side}" in self._streams:
            pairs.append(self._glove(side))
        if f"keypoints_{side}" in self._streams:
            place = self._place(f"finger_tracker_{side}")
            pairs.append(mock_finger_tracker(side, self._streams[f"keypoints_{side}"], place))
        return pairs

    def _place(self, name: str) -> TrackerPlace:
        return TrackerPlace(self._links.trackers, self._faults.of(name), self._seed, self._clock)

    def _glove(self, side: Side) -> MockPair:
        stream, faults = self._streams[f"tactile_{side}"], self._faults.of(f"glove_{side}")
        place = MockPlace(side, stream, faults, self._seed, self._clock)
        return self._make_glove(place)

    def _camera(self, stream: str) -> MockPair:
        replay, images = self._streams[stream], self._links.images
        if self._links.cameras == "station":
            return video_camera(
                replay,
                faults=self._faults.of(stream),
                seed=self._seed,
                clock=self._clock,
                encoding=images,
            )
        height_px, width_px = replay.descriptor.shape[:2]
        decoder = CameraDecoder(stream, height_px=height_px, width_px=width_px, encoding=images)
        port = SocketPort(stream)
        driver = CameraDriver(stream, transport=port.transport, decoder=decoder, clock=self._clock)
        return MockPair(self._device(stream, CameraSource(replay, encoding=images), port), driver)

    def _device(self, name: str, source: PacketSource, port: MockPort) -> MockDevice:
        faults = self._faults.of(name)
        return MockDevice(name, source=source, port=port, faults=faults, seed=self._seed)


def duration_ns(streams: Mapping[str, ReplayStream]) -> int:
    """Length of one round of all streams: the last sample and one period of its stream."""
    return max(int(s.t_ns[-1]) + s.descriptor.period_ns() for s in streams.values())
