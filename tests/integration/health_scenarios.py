"""What can happen to a station of simulated devices, and the finding it must be told by."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from dextouch.errors import DeviceError
from dextouch.schemas import HealthEvent, TakePrompt
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.devices.station_camera import StationCamera
from services.acquisition.health.monitor import STATION
from services.acquisition.health.station import DiskCheck
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, Fate, FaultScript, Ledger
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams
from services.acquisition.mocks.replay import MockPair, ReplayStream
from services.acquisition.settings import MockLinks

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
# The device with the fault stands beside a head tracker that is never disturbed.
UNDISTURBED = "head"
GLOVE, FINGERS, WRIST = "glove_left", "finger_tracker_left", "pose_tracker_wrist_left"
CAMERA = "camera_head"
STREAM_OF = {GLOVE: "tactile_left", FINGERS: "keypoints_left", WRIST: "wrist_left", CAMERA: CAMERA}
ROUND_S = 4.0
AT_S = 1.5
SOON_S = 2.0
# Cells in the middle of the palm, which something presses all the time.
# A place of the grid over which something wanders within the first second.
WUJI_CELLS = (16 * 32 + 18,)
PALM_CELLS = (11 * 20 + 8, 11 * 20 + 9, 12 * 20 + 8, 13 * 20 + 11)
# Faults that begin at a time of their own; others begin with the first packet that they touch.
TIMED = {
    "stalls_s",
    "clock_step_at_s",
    "wrong_side_from_s",
    "version_from_s",
    "unplugged_s",
    "occluded_s",
    "not_running_s",
    "jumped_s",
}
EARLY_NS = 60_000_000
DAY_S = 86_400.0
SHORT_OF_DISK_S = 20 * 60.0

Edit = Callable[[ReplayStream], ReplayStream]
Disturb = Callable[[MockStation, MockPair], None]


@dataclass(frozen=True)
class Scenario:
    """One fault.

    Attributes:
        device: that has it.
        codes: the finding it must be told by, or one of several where it depends on what the
            driver tells.
        faults: of the mock.
        links: of the mock station.
        edit: changes what the device plays.
        disturb: changes the station before it starts.
        calibration: instead of the usual one.
        is_timed: whether what `edit` or `disturb` does begins at `AT_S`.
        limit_s: within which it must be found.
        on_station: whether the station itself is told, and no stream.
    """

    device: str
    codes: str
    faults: Mapping[str, object] = field(default_factory=dict)
    links: MockLinks = field(default_factory=MockLinks)
    edit: Edit | None = None
    disturb: Disturb | None = None
    calibration: Mapping[str, tuple[tuple[float, ...], ...]] | None = None
    is_timed: bool = False
    limit_s: float = SOON_S
    on_station: bool = False

    @property
    def where(self) -> str:
        """Stream that the finding must be raised on."""
        return STATION if self.on_station else STREAM_OF[self.device]


@dataclass(frozen=True)
class Outcome:
    """What was raised first by stream and code, and how long after the fault began."""

    seconds: dict[tuple[str, str], float]

    def found(self, scenario: Scenario) -> tuple[str, float] | None:
        """The right code and its time."""
        for code in scenario.codes.split():
            if (scenario.where, code) in self.seconds:
                return code, self.seconds[scenario.where, code]
        return None

    def accused(self, scenario: Scenario) -> set[str]:
        """Other streams on which something was raised."""
        return {stream for stream, _ in self.seconds} - {scenario.where}

    def besides(self, scenario: Scenario) -> list[str]:
        """Other codes on the right stream."""
        found = self.found(scenario)
        right = None if found is None else found[0]
        return sorted(c for s, c in self.seconds if s == scenario.where and c != right)


def observe(scenario: Scenario, spool_root) -> Outcome:
    """Record a take with the fault, in virtual time."""
    names = (STREAM_OF[scenario.device], UNDISTURBED)
    streams = [s for s in pattern_streams(ROUND_S) if s.descriptor.name in names]
    if scenario.edit is not None:
        streams = [scenario.edit(s) if s.descriptor.name == names[0] else s for s in streams]
    faults = DeviceFaults.model_validate(dict(scenario.faults))
    calibration = pattern_calibration() if scenario.calibration is None else scenario.calibration
    mock = MockStation(
        streams,
        FaultScript(devices={scenario.device: faults}),
        5,
        VirtualClock(),
        spool_root=spool_root,
        calibration=calibration,
        links=scenario.links,
    )
    if scenario.disturb is not None:
        (pair,) = [pair for pair in mock.pairs if pair.device.name == scenario.device]
        scenario.disturb(mock, pair)
    with mock:
        ledger = mock.run_take(PROMPT, recording_id="take").ledger
        events = mock.station.health.events().events
    began_ns = onset_ns(scenario, ledger)
    first: dict[tuple[str, str], HealthEvent] = {}
    for event in events:
        if event.level != "OK":
            first.setdefault((event.stream, event.code), event)
    return Outcome({key: (e.t_host_ns - began_ns) * 1e-9 for key, e in first.items()})


def onset_ns(scenario: Scenario, ledger: Ledger) -> int:
    """When the fault began, on the station's clock."""
    if scenario.is_timed or TIMED & set(scenario.faults):
        return ledger.start_host_ns + round(AT_S * 1e9)
    entries = ledger.of(scenario.device)
    pairs = zip(entries.t_true_ns, entries.fate, strict=True)
    odd = [t_ns for t_ns, fate in pairs if fate != Fate.SENT]
    return odd[0] if odd else entries.t_true_ns[0]


def from_now_on(stream: ReplayStream) -> np.ndarray:
    """Which samples are taken after the fault began."""
    return stream.t_ns >= AT_S * 1e9


def changed(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """Values that are others from the fault on."""

    def edit(stream: ReplayStream) -> ReplayStream:
        values, later = stream.values.copy(), from_now_on(stream)
        values[later] = change(values[later])
        return replace(stream, values=values)

    return edit


def slower(stream: ReplayStream) -> ReplayStream:
    """15 % fewer samples a second than the device announces."""
    t_ns = np.rint(stream.t_ns / 0.85).astype(np.int64)
    kept = t_ns < ROUND_S * 1e9
    return replace(stream, t_ns=t_ns[kept], values=stream.values[kept])


def at_rest(stream: ReplayStream) -> ReplayStream:
    """A body that does not move."""
    return replace(stream, values=np.broadcast_to(stream.values[0], stream.values.shape).copy())


def in_millimetres(stream: ReplayStream) -> ReplayStream:
    """Positions in another unit, as long as the device plays."""
    return replace(stream, values=stream.values * ([1000] * 3 + [1] * 4))


def frozen_amid_noise(stream: ReplayStream) -> ReplayStream:
    """A noisy tracker that repeats its last pose."""
    noise_m = 5e-4 * np.random.default_rng(0).standard_normal((len(stream.values), 3))
    noisy = stream.values + np.pad(noise_m, ((0, 0), (0, 4)))
    return changed(lambda values: np.broadcast_to(values[0], values.shape))(
        replace(stream, values=noisy.astype(stream.values.dtype))
    )


def untouched_then_shifted(stream: ReplayStream) -> ReplayStream:
    """An open hand whose zero moves by 0.5 kPa."""
    return changed(lambda values: values + np.float32(0.5))(
        replace(stream, values=0 * stream.values)
    )


def without_some(stream: ReplayStream) -> ReplayStream:
    """Three images are never taken."""
    stream = seen_by_a_sensor(stream)
    index = np.flatnonzero(from_now_on(stream))[:3]
    t_ns, values = np.delete(stream.t_ns, index), np.delete(stream.values, index, axis=0)
    return replace(stream, t_ns=t_ns, values=values)


def seen_by_a_sensor(stream: ReplayStream) -> ReplayStream:
    """A table with a texture, and the sensor's noise."""
    rng = np.random.default_rng(5)
    texture = rng.normal(0.0, 20.0, stream.values.shape[1:])
    noise = rng.normal(0.0, 2.0, stream.values.shape)
    images = np.clip(stream.values + texture + noise, 10, 240).astype(np.uint8)
    return replace(stream, values=images)


def changed_images(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """The same of a camera with texture and noise."""
    return lambda stream: changed(change)(seen_by_a_sensor(stream))


def covered(images: np.ndarray) -> np.ndarray:
    """Half of the image is white."""
    images[:, : images.shape[1] // 2] = 255
    return images


def stamp_early(_: MockStation, pair: MockPair) -> None:
    """What is read waits for 60 ms in the host before it is spooled."""
    clock = pair.driver._clock

    class Early(StationClock):
        def now_ns(self):
            return clock.now_ns() - EARLY_NS

    pair.driver._clock = Early()


def lose_stamps(mock: MockStation, pair: MockPair) -> None:
    """The device goes on without telling its time."""
    read = pair.driver.read

    def without_stamps():
        readings = read()
        if not is_later(mock, pair):
            return readings
        return {
            name: [replace(sample, t_device_ns=-1) for sample in samples]
            for name, samples in readings.items()
        }

    pair.driver.read = without_stamps


def refuse(mock: MockStation, pair: MockPair) -> None:
    """Something opens at the device's address and speaks in an unknown way."""
    read = pair.driver.read

    def read_or_refuse():
        readings = read()
        if readings and is_later(mock, pair):
            raise DeviceError("glove: no packet of any known kind")
        return readings

    pair.driver.read = read_or_refuse


def reboot(_: MockStation, pair: MockPair) -> None:
    """The device starts anew: counter and clock begin again."""
    source = pair.device.source
    first = int(np.flatnonzero(source.t_ns >= AT_S * 1e9)[0])
    units = source.units

    def rebooted(index, sequence, t_device_ns):
        if index < first:
            return units(index, sequence, t_device_ns)
        since_ns = int(source.t_ns[index] - source.t_ns[first])
        return units(index, index - first, 10**6 + since_ns)

    source.units = rebooted


def drop_images(mock: MockStation, pair: MockPair) -> None:
    """The encoder does not keep up."""

    class Dropping(StationCamera):
        @property
        def quality(self):
            count = self.statistics.packets if is_later(mock, pair) else 0
            return replace(super().quality, num_dropped=count)

    pair.driver.__class__ = Dropping


def fill_disk(mock: MockStation, pair: MockPair) -> None:
    """Little is left where the takes go."""
    del pair
    health = mock.station.health
    bytes_a_s = 60 * 720 + 100 * 56
    disk = DiskCheck(
        mock.station.recorder.spool_root,
        mock.station.supervisors,
        mock.station.clock.now_ns(),
        free_bytes=lambda: round(SHORT_OF_DISK_S * bytes_a_s),
    )
    health.watch(disk)


def is_later(mock: MockStation, pair: MockPair) -> bool:
    """Whether the fault has begun."""
    start_ns = pair.device._start_host_ns
    return start_ns > 0 and mock.station.clock.now_ns() >= start_ns + AT_S * 1e9


WUJI, BARE = MockLinks(gloves="wuji_glove"), MockLinks(gloves="justfloat_glove")
OWN_CAMERA = MockLinks(cameras="station")
SHORT, PAUSE = ((AT_S, AT_S + 0.15),), ((AT_S, AT_S + 0.8),)

SCENARIOS: dict[str, Scenario] = {
    "packets dropped": Scenario(GLOVE, "loss", {"drop_probability": 0.05}),
    "bit errors": Scenario(GLOVE, "damage", {"bit_error_rate": 1e-5}),
    "bytes lost": Scenario(GLOVE, "damage", {"byte_loss_rate": 1e-4}),
    "half packets": Scenario(GLOVE, "damage", {"half_packet_probability": 0.05}),
    "duplicate packets": Scenario(GLOVE, "repeated", {"duplicate_probability": 0.05}),
    "packets out of order": Scenario(GLOVE, "reordered", {"reorder_probability": 0.05}),
    "silence of 0.4 s": Scenario(GLOVE, "silent", {"stalls_s": ((AT_S, AT_S + 0.4),)}, limit_s=0.3),
    "pause of 0.15 s": Scenario(WRIST, "gap", {"stalls_s": SHORT}),
    "bursts": Scenario(FINGERS, "jitter", {"burst_ms": 100.0}),
    "85 % of the rate": Scenario(WRIST, "rate", edit=slower),
    "60 ms of host latency": Scenario(WRIST, "latency", disturb=stamp_early),
    "latency jitter of 10 ms": Scenario(GLOVE, "clock_residual", {"jitter_ms": 10.0}),
    "clock steps forward": Scenario(
        GLOVE, "clock_step", {"clock_step_at_s": AT_S, "clock_step_s": 0.2}
    ),
    "clock steps backward": Scenario(
        GLOVE, "clock_step", {"clock_step_at_s": AT_S, "clock_step_s": -0.03}
    ),
    "clock off by 3000 ppm": Scenario(GLOVE, "clock_skew", {"skew_ppm": 3000.0}),
    "timestamps missing": Scenario(GLOVE, "clock_stamps", disturb=lose_stamps, is_timed=True),
    "device restarts": Scenario(GLOVE, "restart", disturb=reboot, is_timed=True),
    "other hand": Scenario(GLOVE, "wrong_side rejected", {"wrong_side_from_s": AT_S}),
    "other tracker": Scenario(WRIST, "wrong_side rejected", {"wrong_side_from_s": AT_S}),
    "other hand (Wuji)": Scenario(
        GLOVE, "wrong_side rejected", {"wrong_side_from_s": AT_S}, links=WUJI
    ),
    "other version": Scenario(GLOVE, "wrong_version rejected", {"version_from_s": AT_S}),
    "unknown protocol": Scenario(GLOVE, "rejected", disturb=refuse, is_timed=True),
    "unplugged (serial)": Scenario(GLOVE, "unplugged", {"unplugged_s": PAUSE}, limit_s=0.3),
    "unplugged (HID)": Scenario(WRIST, "unplugged", {"unplugged_s": PAUSE}, limit_s=0.3),
    "loose plug": Scenario(GLOVE, "reconnect", {"unplugged_s": SHORT}),
    "taxels dead": Scenario(GLOVE, "taxels_dead", {"dead_taxels": PALM_CELLS}),
    "taxels stuck": Scenario(GLOVE, "taxels_stuck", {"stuck_taxels": PALM_CELLS}),
    "taxels saturated": Scenario(GLOVE, "taxels_saturated", {"saturated_taxels": PALM_CELLS}),
    "zero drifts": Scenario(GLOVE, "baseline", edit=untouched_then_shifted, is_timed=True),
    "cells stuck (Wuji)": Scenario(GLOVE, "taxels_stuck", {"stuck_taxels": WUJI_CELLS}, links=WUJI),
    "cells saturated (Wuji)": Scenario(
        GLOVE, "taxels_saturated", {"saturated_taxels": WUJI_CELLS}, links=WUJI
    ),
    "cell becomes NaN (Wuji)": Scenario(GLOVE, "nan", {"nan_probability": 0.05}, links=WUJI),
    "NaN (justfloat)": Scenario(GLOVE, "suspect", {"nan_probability": 0.05}, links=BARE),
    "NaN (pose)": Scenario(WRIST, "refused", {"nan_probability": 0.05}),
    "tracker occluded": Scenario(WRIST, "tracking", {"occluded_s": SHORT}),
    "tracker not running": Scenario(WRIST, "tracking", {"not_running_s": SHORT}),
    "thumb occluded": Scenario(FINGERS, "tracking", {"occluded_s": PAUSE}),
    "pose jumps": Scenario(WRIST, "jump", {"jumped_s": SHORT}),
    "pose noise of 0.2 m": Scenario(WRIST, "jump", {"position_noise_m": 0.2}),
    "pose in millimetres": Scenario(WRIST, "implausible", edit=in_millimetres),
    "pose frozen": Scenario(WRIST, "frozen", edit=frozen_amid_noise, is_timed=True),
    "pose noise of 3 mm": Scenario(WRIST, "pose_jitter", {"position_noise_m": 3e-3}, edit=at_rest),
    "image frozen": Scenario(
        CAMERA, "image_frozen", edit=changed_images(lambda images: images[:1]), is_timed=True
    ),
    "image blurred": Scenario(
        CAMERA,
        "image_blurred",
        edit=changed_images(lambda images: 100 + images // 8),
        is_timed=True,
    ),
    "image clipped": Scenario(CAMERA, "image_clipped", edit=changed_images(covered), is_timed=True),
    "images skipped": Scenario(CAMERA, "image_gap", edit=without_some, is_timed=True),
    "images not encoded": Scenario(
        CAMERA, "queue", links=OWN_CAMERA, edit=seen_by_a_sensor, disturb=drop_images, is_timed=True
    ),
    "disk full in 20 min": Scenario(GLOVE, "disk", disturb=fill_disk, on_station=True),
    "no camera matrix": Scenario(CAMERA, "calibration_missing", calibration={}, on_station=True),
    "calibrated 8 days ago": Scenario(
        GLOVE,
        "calibration_age",
        calibration={"calibrated_at_unix_s": ((time.time() - 8 * DAY_S,),)},
        on_station=True,
    ),
}
HARMLESS = {
    "nothing": Scenario(GLOVE, ""),
    "counter_wrap": Scenario(GLOVE, "", {"first_sequence": 2**32 - 60}),
    "ordinary_skew_and_delay": Scenario(
        GLOVE, "", {"skew_ppm": 50.0, "path_delay_ms": 3.0, "jitter_ms": 0.8}
    ),
    "wuji_glove": Scenario(GLOVE, "", {"jitter_ms": 0.8}, links=WUJI),
    "justfloat_glove": Scenario(GLOVE, "", {"jitter_ms": 0.8}, links=BARE),
    "camera": Scenario(CAMERA, "", {"path_delay_ms": 12.0, "jitter_ms": 0.8}, links=OWN_CAMERA),
    "fingers": Scenario(FINGERS, "", {"position_noise_m": 5e-4}),
}
