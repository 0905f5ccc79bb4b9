"""Streams of an episode come in; mock devices and the drivers that read them go out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dextouch.errors import InvalidInputError
from dextouch.schemas.episodes import Matrix, matrix_rows
from dextouch.tactile.layout import SIDES, Side
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.camera import CameraDecoder, ImageEncoding
from services.acquisition.drivers.finger_tracker import FingerTracker
from services.acquisition.drivers.pose_tracker import PoseTrackerDecoder
from services.acquisition.drivers.robot_state import STREAM_SIZES, RobotStateDecoder
from services.acquisition.mocks.camera import CameraSource
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.finger_tracker import FingerTrackerSource
from services.acquisition.mocks.glove_devices import mock_glove
from services.acquisition.mocks.ports import HidPort, MockPort, SocketPort
from services.acquisition.mocks.pose_tracker import PoseTrackerSource
from services.acquisition.mocks.replay import (
    MockDevice,
    PacketSource,
    ReplayStream,
    device_rng,
)
from services.acquisition.mocks.robot_state import RobotStateSource
from services.acquisition.mocks.tactile_glove import GloveCalibration

LATENCY_SIGMA_MS = 0.2


@dataclass(frozen=True)
class MockPair:
    """A simulated device and the real driver on its other end."""

    device: MockDevice
    driver: Driver


class MockFactory:
    """Builds the devices that a set of streams needs.

    Args:
        streams: of one episode; truth-only streams are left out.
        faults: what disturbs the devices.
        seed: of noise, calibration and faults.
        clock: of the station.
        image_encoding: of the cameras on the wire.
    """

    def __init__(
        self,
        streams: Sequence[ReplayStream],
        *,
        faults: FaultScript,
        seed: int,
        clock: StationClock,
        image_encoding: ImageEncoding = "rgb8",
    ) -> None:
        self._streams = {stream.descriptor.name: stream for stream in streams}
        if len(self._streams) != len(streams):
            raise InvalidInputError("mock station: two streams of the same name")
        self._faults = faults
        self._seed = seed
        self._clock = clock
        self._encoding: ImageEncoding = image_encoding
        self._gloves = {side: GloveCalibration.seeded(side, seed) for side in SIDES}

    def build(self) -> list[MockPair]:
        """One pair a device.

        Raises:
            InvalidInputError: no stream that any device sends.
        """
        pairs = [pair for side in SIDES for pair in self._hand(side)]
        if "joints_measured" in self._streams:
            parts = {name: s for name, s in self._streams.items() if name in STREAM_SIZES}
            decoder = RobotStateDecoder()
            pairs.append(
                self._pair("robot_state", RobotStateSource(parts), SocketPort("robot"), decoder)
            )
            trackers = ["head"]
        else:
            trackers = ["wrist_left", "wrist_right", "head"]
        pairs += [self._pose_tracker(name) for name in trackers if name in self._streams]
        pairs += [self._camera(name) for name in self._streams if name.startswith("camera_")]
        if not pairs:
            raise InvalidInputError(
                f"mock station: got streams {sorted(self._streams)}, expected tactile_…, "
                "keypoints_…, wrist_…, head, camera_… or joints_…"
            )
        return pairs

    def calibration(self) -> dict[str, Matrix]:
        """What a calibrated station knows of its gloves: tare and gain of the 360 cells."""
        record: dict[str, Matrix] = {}
        for side in SIDES:
            if f"tactile_{side}" in self._streams:
                glove = self._gloves[side]
                gain = glove.gain_counts_per_kpa
                record[f"tactile_{side}_tare_counts"] = matrix_rows(glove.tare_counts[None])
                record[f"tactile_{side}_gain_counts_per_kpa"] = matrix_rows(gain[None])
        return record

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
            pair = mock_glove(
                side,
                self._streams[f"tactile_{side}"],
                calibration=self._gloves[side],
                faults=self._faults.of(f"glove_{side}"),
                seed=self._seed,
                clock=self._clock,
            )
            pairs.append(MockPair(*pair))
        if f"keypoints_{side}" in self._streams:
            pairs.append(self._finger_tracker(side))
        return pairs

    def _finger_tracker(self, side: Side) -> MockPair:
        name = f"finger_tracker_{side}"
        source = FingerTrackerSource(
            self._streams[f"keypoints_{side}"],
            side=side,
            noise_m=self._faults.of(name).position_noise_m,
            rng=device_rng(self._seed, f"noise_{name}"),
        )
        port = HidPort(name, answer=source.answer)
        driver = FingerTracker(name, side, transport=port.transport, clock=self._clock)
        return MockPair(self._device(name, source, port), driver)

    def _pose_tracker(self, stream: str) -> MockPair:
        name = f"pose_tracker_{stream}"
        rng = device_rng(self._seed, f"noise_{name}")
        source = PoseTrackerSource(self._streams[stream], faults=self._faults.of(name), rng=rng)
        return self._pair(name, source, HidPort(name), PoseTrackerDecoder(stream))

    def _camera(self, stream: str) -> MockPair:
        replay = self._streams[stream]
        height_px, width_px = replay.descriptor.shape[:2]
        decoder = CameraDecoder(
            stream, height_px=height_px, width_px=width_px, encoding=self._encoding
        )
        source = CameraSource(replay, encoding=self._encoding)
        return self._pair(stream, source, SocketPort(stream), decoder)

    def _pair(
        self,
        name: str,
        source: PacketSource,
        port: MockPort,
        decoder: PoseTrackerDecoder | CameraDecoder | RobotStateDecoder,
    ) -> MockPair:
        driver = Driver(name, transport=port.transport, decoder=decoder, clock=self._clock)
        return MockPair(self._device(name, source, port), driver)

    def _device(self, name: str, source: PacketSource, port: MockPort) -> MockDevice:
        faults = self._faults.of(name)
        return MockDevice(name, source=source, port=port, faults=faults, seed=self._seed)


def duration_ns(streams: Mapping[str, ReplayStream]) -> int:
    """Length of one round of all streams: the last sample and one period of its stream."""
    return max(int(s.t_ns[-1]) + s.descriptor.period_ns() for s in streams.values())
