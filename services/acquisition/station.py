"""A running station: supervisors of its devices, recorder, health and what viewers see."""

import threading
import time
from collections.abc import Container, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from dextouch.errors import DeviceError, NotFoundError, StaleDataError
from dextouch.geometry import apply, invert, transform_from_pose
from dextouch.images import encode_jpeg
from dextouch.schemas import CameraLive, Matrix, SimulatedFault
from dextouch.streams import H264_UNIT, MOUNTS, NO_DEVICE_TIME, Sample, StreamDescriptor, StreamKind
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.drivers.images import GroupPreview
from services.acquisition.health.glove_records import glove_record
from services.acquisition.health.monitor import HealthMonitor
from services.acquisition.recorder import Recorder
from services.acquisition.settings import SpoolSafety
from services.acquisition.supervisor import DeviceSupervisor
from services.acquisition.watches import FollowWatch, MakeFollowCheck, PathWatch

CONNECT_TIMEOUT_S = 10.0
# Of a quaternion that says where a body points.
LEAST_NORM = 1e-6
MAX_AGE_NS = 500_000_000
# Chosen: clocks part by 60 ms within twice of it at 500 ppm, which is no delay; a queue that stands
# for longer, without growing, is no longer seen.
LEAST_DELAY_SPAN_NS = 60_000_000_000
# Further than packets overtake each other: the device began anew.
RESTART_NS = 1_000_000_000


class Station:
    """Everything that runs beside the devices.

    `faults` are those that a simulated station shows on request, None of real devices; meanwhile
    each reading takes `slow_s` longer.

    `follow` makes the check whether the robot's hand can follow a tracked one; without it there is
    none.
    """

    def __init__(  # noqa: PLR0913 - all by name
        self,
        *,
        name: str,
        drivers: Sequence[Driver],
        spool_root: Path,
        clock: StationClock,
        calibration: Mapping[str, Matrix],
        safety: SpoolSafety | None = None,
        simulated: bool = False,
        follow: MakeFollowCheck | None = None,
    ) -> None:
        self.name = name
        self.clock = clock
        self.faults: tuple[SimulatedFault, ...] | None = () if simulated else None
        self.slow_s = 0.0
        self.live = LiveView(drivers, calibration)
        self.supervisors = [
            DeviceSupervisor(driver, sink=self._accept, clock=clock) for driver in drivers
        ]
        self.paths = PathWatch(self.supervisors, clock=clock)
        descriptors = [descriptor for driver in drivers for descriptor in driver.descriptors]
        self.follow = FollowWatch(descriptors, calibration, follow, clock=clock)
        self.health = HealthMonitor(
            self.supervisors,
            station=name,
            calibration=calibration,
            clock=clock,
            paths=self.paths,
            follow=self.follow,
            simulated=simulated,
        )
        self.recorder = Recorder(
            station=name,
            spool_root=spool_root,
            drivers=drivers,
            clock=clock,
            calibration=calibration,
            safety=safety,
            device_events=lambda: {s.driver.name: s.events() for s in self.supervisors},
            health=self.health,
            latencies=self.paths.latencies,
            follow=self.follow,
        )

    def start(self) -> None:
        """Start all readers and the health evaluation."""
        for supervisor in self.supervisors:
            supervisor.start()
        self.health.start()
        self.paths.start()
        self.follow.start()

    def wait_connected(self, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        """Block until every device answers.

        Raises:
            DeviceError: some do not; the message names them.
        """
        missing = [s.driver.name for s in self.supervisors if not s.connected.wait(timeout_s)]
        if missing:
            raise DeviceError(f"devices {missing} did not connect within {timeout_s:g} s")

    def stop(self) -> None:
        """Stop everything; an unsaved take stays in the spool."""
        # First, while the readers still bring the answer that it may wait for.
        self.paths.stop()
        self.follow.stop()
        self.health.stop()
        stoppers = [threading.Thread(target=supervisor.stop) for supervisor in self.supervisors]
        for stopper in stoppers:
            stopper.start()
        for stopper in stoppers:
            stopper.join()
        self.recorder.close()

    def is_working(self) -> bool:
        """Whether health is evaluated, devices are read and a running take is written.

        A device that is absent or lost is no stall: its thread waits for it.
        """
        take = self.recorder.take
        is_read = all(supervisor.is_running for supervisor in self.supervisors)
        return is_read and self.health.is_running and (take is None or take.is_working())

    def _accept(self, readings: Readings) -> None:
        if self.slow_s:
            time.sleep(self.slow_s)
        take = self.recorder.take
        if take is not None:
            take.accept(readings)
        self.live.accept(readings)
        self.follow.accept(readings)
        now_ns = self.clock.now_ns()
        for name, samples in readings.items():
            self.health.queues[name].add(samples, now_ns)
        if self.paths.asks:
            self.paths.accept(readings)


class ArrivalDelay:
    """How much later than at best a device's newest sample arrived, by the device's own clock.

    The fastest arrival of the last minutes counts as no delay. Samples wait, for example, in the
    queue of a link that an overloaded computer reads too slowly; their age does not show it.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        clock = descriptor.capabilities
        # A wider counter never wraps.
        bits = clock.device_time_bits
        self._wrap_ns = 2**bits * clock.tick_ns if bits <= 62 else None
        # After a longer pause clocks may have parted, or the counter wrapped.
        self._pause_ns = min(LEAST_DELAY_SPAN_NS, (self._wrap_ns or 2**62) // 2)
        self._last: tuple[int, int] | None = None
        self._delay_ns = self._least_ns = self._least_before_ns = 0
        self._since_ns = 0

    @property
    def late_ns(self) -> int:
        """Delay of the newest sample."""
        return self._delay_ns - min(self._least_ns, self._least_before_ns)

    def add(self, sample: Sample) -> None:
        """Account for a sample; one without a device time changes nothing."""
        if sample.t_device_ns == NO_DEVICE_TIME:
            return
        stamps = (sample.t_host_ns, sample.t_device_ns)
        (host_ns, device_ns), self._last = self._last or stamps, stamps
        step_ns = sample.t_device_ns - device_ns
        if self._wrap_ns is not None:
            step_ns = (step_ns + self._wrap_ns // 2) % self._wrap_ns - self._wrap_ns // 2
        if step_ns < -RESTART_NS or sample.t_host_ns - host_ns > self._pause_ns:
            self._delay_ns = self._least_ns = self._least_before_ns = 0
            return
        self._delay_ns += sample.t_host_ns - host_ns - step_ns
        if sample.t_host_ns - self._since_ns > LEAST_DELAY_SPAN_NS:
            self._since_ns = sample.t_host_ns
            self._least_before_ns, self._least_ns = self._least_ns, self._delay_ns
        self._least_ns = min(self._least_ns, self._delay_ns)


class LiveView:
    """Keeps the newest sample of each stream; nothing is computed until it is requested."""

    def __init__(self, drivers: Sequence[Driver], calibration: Mapping[str, Matrix]) -> None:
        self._descriptors = {d.name: d for driver in drivers for d in driver.descriptors}
        self._newest: dict[str, Sample] = {}
        self._num_images: dict[str, int] = {}
        self._delays = {
            name: ArrivalDelay(descriptor)
            for name, descriptor in self._descriptors.items()
            if descriptor.capabilities.device_time
        }
        self._previews = {
            name: GroupPreview((d.shape[0], d.shape[1]))
            for name, d in self._descriptors.items()
            if d.unit == H264_UNIT
        }
        self._calibration = {
            name: np.array(matrix)
            for name, matrix in calibration.items()
            if name.startswith("T_") and np.shape(matrix) == (4, 4)
        }
        # Without a calibration the station starts all the same: it records the takes for one.
        self._gloves = {
            name: glove
            for name, descriptor in self._descriptors.items()
            if (glove := glove_record(descriptor, calibration)) is not None
        }

    def accept(self, readings: Readings) -> None:
        """Remember (called by the reader threads)."""
        for name, samples in readings.items():
            if name in self._previews:
                for sample in samples:
                    self._previews[name].add(bytes(sample.values.item()))
            self._newest[name] = samples[-1]
            if name in self._delays:
                self._delays[name].add(samples[-1])
            self._num_images[name] = self._num_images.get(name, 0) + len(samples)

    def pressures_kpa(self, now_ns: int) -> dict[str, Float32[np.ndarray, " taxels"]]:
        """Newest pressures by stream, of gloves heard within the last 0.5 s; never older ones.

        Taxels that the glove has not, or from which it has no reading, are 0.
        """
        pressures: dict[str, np.ndarray] = {}
        for name, glove in self._gloves.items():
            sample = self._newest.get(name)
            if sample is None or now_ns - sample.t_host_ns > MAX_AGE_NS:
                continue
            pressures[name] = glove.to_kpa(sample.values.reshape(1, -1))[0].astype(np.float32)
        return pressures

    def ages_s(self, kinds: Container[StreamKind], now_ns: int) -> dict[str, float | None]:
        """Age of the newest sample of each stream of these kinds; None where none ever came."""
        found: dict[str, float | None] = {}
        for name, descriptor in self._descriptors.items():
            if descriptor.kind in kinds:
                newest = self._newest.get(name)
                # One may have come since.
                found[name] = None if newest is None else max(0, now_ns - newest.t_host_ns) / 1e9
        return found

    def late_s(self, kinds: Container[StreamKind]) -> dict[str, float]:
        """Delay of the newest sample (see `ArrivalDelay`) of streams whose device has a clock."""
        return {
            name: delay.late_ns / 1e9
            for name, delay in self._delays.items()
            if self._descriptors[name].kind in kinds
        }

    def poses(self, now_ns: int, *, mounted: bool = True) -> dict[str, Float32[np.ndarray, "n m"]]:
        """Newest poses and keypoints by stream, of those heard within the last 0.5 s.

        Returns:
            Of a body its pose T_world_NAME [4, 4], of a hand its keypoints [25, 3] in wrist axes,
            metres; a node that is not seen is NaN. The mounts of the calibration are applied; if
            not `mounted`, poses are those of the trackers.
        """
        found: dict[str, np.ndarray] = {}
        for name, descriptor in self._descriptors.items():
            sample = self._newest.get(name)
            if sample is None or now_ns - sample.t_host_ns > MAX_AGE_NS:
                continue
            values = np.asarray(sample.values, dtype=np.float64)
            if descriptor.kind == "keypoints":
                mount = self._calibration.get(f"T_{name}_wrist_{descriptor.side}")
                found[name] = values if mount is None else apply(invert(mount), values)
            elif descriptor.kind == "pose" and _is_pose(values):
                T = transform_from_pose(values)
                found[name] = self._in_world(descriptor, T) if mounted else T
        return {name: values.astype(np.float32) for name, values in found.items()}

    def _in_world(self, descriptor: StreamDescriptor, T: np.ndarray) -> np.ndarray:
        if descriptor.frame == "base" and "T_world_base" in self._calibration:
            T = self._calibration["T_world_base"] @ T
        mount = self._calibration.get(MOUNTS.get(descriptor.name, ""))
        return T if mount is None else T @ mount

    def cameras(self, now_ns: int) -> list[CameraLive]:
        """Cameras that have sent an image."""
        found, late_s = [], self.late_s({"image"})
        for name, descriptor in sorted(self._descriptors.items()):
            sample = self._newest.get(name)
            if descriptor.kind == "image" and sample is not None:
                found.append(
                    CameraLive(
                        name=name,
                        image_index=self._num_images[name],
                        age_s=(now_ns - sample.t_host_ns) / 1e9,
                        late_s=late_s.get(name),
                        height_px=descriptor.shape[0],
                        width_px=descriptor.shape[1],
                    )
                )
        return found

    def jpeg(self, camera: str, now_ns: int) -> bytes:
        """Newest image of a camera as JPEG.

        Raises:
            NotFoundError: no such camera, or no image yet (of H.264: no key frame yet).
            StaleDataError: the newest image is older than 0.5 s.
        """
        descriptor = self._descriptors.get(camera)
        sample = self._newest.get(camera)
        if descriptor is None or descriptor.kind != "image" or sample is None:
            raise NotFoundError(f"camera {camera!r}: not there, or no image yet")
        age_s = (now_ns - sample.t_host_ns) / 1e9
        if age_s * 1e9 > MAX_AGE_NS:
            raise StaleDataError(f"camera {camera!r}: the newest image is {age_s:.1f} s old")
        if descriptor.unit == "jpeg":
            return bytes(sample.values.item())
        if camera in self._previews:
            return encode_jpeg(self._previews[camera].image())
        return encode_jpeg(sample.values)


def _is_pose(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and np.linalg.norm(values[3:]) > LEAST_NORM)
