"""A seeded script of faults: what happens to each packet of a mock device, and when."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Int64
from pydantic import Field, model_validator

from dextouch.frozen_model import FrozenModel

MILLISECOND_NS = 1_000_000
MAX_BOOT_NS = 10**12
WINDOWS = ("stalls_s", "unplugged_s", "occluded_s", "not_running_s", "jumped_s")


class DeviceFaults(FrozenModel):
    """What disturbs one device; the default is a perfect one.

    Times in seconds count from the start of the device's first take. `jitter_ms` is the mean of an
    exponential delay on top of the constant `path_delay_ms`; packets never overtake each other.
    Noise is per axis. `bit_error_rate` and `byte_loss_rate` act on serial lines only: USB and
    sockets have checksums of their own.

    What comes during one of `stalls_s` arrives at its end; with `burst_ms` packets arrive together
    at multiples of it. A reordered packet arrives behind the next one, of a half one the rest never
    comes. From `wrong_side_from_s` on the other hand's device answers, from `version_from_s` on one
    of another packet version. The counter starts at `first_sequence` and wraps at 2^32.
    `dead_taxels` are raw cells that always read zero, stuck ones a constant, saturated ones full
    scale. `nan_probability` puts a NaN into a packet of numbers.

    Trackers only, counted from the start of every round: during `occluded_s` a pose tracker says
    that it is out of range and drifts, a finger tracker does not see the thumb; during
    `not_running_s` a pose tracker has no tracking at all; during `jumped_s` it says that it runs,
    but its pose is elsewhere.
    """

    skew_ppm: float = Field(default=0.0, ge=-10_000, le=10_000)
    path_delay_ms: float = Field(default=0.0, ge=0, le=1_000)
    jitter_ms: float = Field(default=0.0, ge=0, le=1_000)
    drop_probability: float = Field(default=0.0, ge=0, le=1)
    duplicate_probability: float = Field(default=0.0, ge=0, le=1)
    reorder_probability: float = Field(default=0.0, ge=0, le=1)
    half_packet_probability: float = Field(default=0.0, ge=0, le=1)
    nan_probability: float = Field(default=0.0, ge=0, le=1)
    bit_error_rate: float = Field(default=0.0, ge=0, le=0.01)
    byte_loss_rate: float = Field(default=0.0, ge=0, le=0.01)
    stalls_s: tuple[tuple[float, float], ...] = ()
    burst_ms: float = Field(default=0.0, ge=0, le=1_000)
    position_noise_m: float = Field(default=0.0, ge=0, le=1)
    rotation_noise_rad: float = Field(default=0.0, ge=0, le=1)
    dead_taxels: tuple[int, ...] = ()
    stuck_taxels: tuple[int, ...] = ()
    saturated_taxels: tuple[int, ...] = ()
    occluded_s: tuple[tuple[float, float], ...] = ()
    not_running_s: tuple[tuple[float, float], ...] = ()
    jumped_s: tuple[tuple[float, float], ...] = ()
    first_sequence: int = Field(default=0, ge=0, lt=2**32)
    wrong_side_from_s: float | None = None
    version_from_s: float | None = None
    unplugged_s: tuple[tuple[float, float], ...] = ()
    clock_step_at_s: float | None = None
    clock_step_s: float = Field(default=0.0, ge=-0.5, le=10)

    @model_validator(mode="after")
    def _windows_in_order(self) -> "DeviceFaults":
        for name in WINDOWS:
            windows: tuple[tuple[float, float], ...] = getattr(self, name)
            edges = [edge for window in windows for edge in window]
            if any(later <= earlier for earlier, later in pairwise(edges)):
                raise ValueError(f"{name}: got {windows}, expected growing times")
        return self


class FaultScript(FrozenModel):
    """The faults of every device of a station, by device name."""

    devices: Mapping[str, DeviceFaults] = {}
    others: DeviceFaults = DeviceFaults()

    def of(self, device: str) -> DeviceFaults:
        """What disturbs this device."""
        return self.devices.get(device, self.others)

    @staticmethod
    def first_light() -> "FaultScript":
        """What an ordinary station does to its data: the faults of the demo."""
        base = DeviceFaults(skew_ppm=50.0, jitter_ms=0.8, drop_probability=0.002)
        glove = {"path_delay_ms": 2.0, "bit_error_rate": 1e-6}
        fingers = {"path_delay_ms": 4.0, "position_noise_m": 5e-4}
        tracker = {**fingers, "rotation_noise_rad": float(np.deg2rad(0.05))}
        camera = {"path_delay_ms": 30.0}
        robot = {"path_delay_ms": 1.0}
        changes = {
            "glove_left": glove,
            "glove_right": glove,
            "finger_tracker_left": fingers,
            "finger_tracker_right": fingers,
            "pose_tracker_wrist_left": tracker,
            "pose_tracker_wrist_right": tracker,
            "pose_tracker_head": tracker,
            "camera_head": camera,
            "camera_wrist_left": camera,
            "camera_wrist_right": camera,
            "robot_state": robot,
        }
        devices = {name: base.model_copy(update=change) for name, change in changes.items()}
        return FaultScript(devices=devices, others=base)


@dataclass(frozen=True)
class Schedule:
    """What happens to each packet of a device; times count from the start of the take."""

    t_true_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    t_arrival_ns: Int64[np.ndarray, " n"]
    is_dropped: Bool[np.ndarray, " n"]
    is_unplugged: Bool[np.ndarray, " n"]


def boot_time_ns(rng: np.random.Generator) -> int:
    """What a device's clock shows when the take starts."""
    return int(rng.integers(10**9, MAX_BOOT_NS))


def make_schedule(
    t_true_ns: np.ndarray, faults: DeviceFaults, *, boot_ns: int, rng: np.random.Generator
) -> Schedule:
    """When each sample is stamped by the device and when its packet reaches the host."""
    t_true_ns = np.asarray(t_true_ns, dtype=np.int64)
    t_device_ns = (
        boot_ns + t_true_ns + np.rint(t_true_ns * (faults.skew_ppm * 1e-6)).astype(np.int64)
    )
    if faults.clock_step_at_s is not None:
        stepped = t_true_ns >= faults.clock_step_at_s * 1e9
        t_device_ns = t_device_ns + stepped * round(faults.clock_step_s * 1e9)
    delay_ms = faults.path_delay_ms + rng.exponential(1.0, len(t_true_ns)) * faults.jitter_ms
    arrival_ns = t_true_ns + np.rint(delay_ms * MILLISECOND_NS).astype(np.int64)
    for start_s, stop_s in faults.stalls_s:
        stalled = (arrival_ns >= start_s * 1e9) & (arrival_ns < stop_s * 1e9)
        arrival_ns[stalled] = round(stop_s * 1e9)
    if faults.burst_ms:
        burst_ns = round(faults.burst_ms * MILLISECOND_NS)
        arrival_ns = -(-arrival_ns // burst_ns) * burst_ns
    arrival_ns = np.maximum.accumulate(arrival_ns)
    is_unplugged = np.zeros(len(t_true_ns), dtype=np.bool_)
    for start_s, stop_s in faults.unplugged_s:
        is_unplugged |= (arrival_ns >= start_s * 1e9) & (arrival_ns < stop_s * 1e9)
    return Schedule(
        t_true_ns,
        t_device_ns,
        arrival_ns,
        (rng.random(len(t_true_ns)) < faults.drop_probability) & ~is_unplugged,
        is_unplugged,
    )


def flip_bits(data: bytes, rate: float, rng: np.random.Generator) -> tuple[bytes, int]:
    """`data` after a line with this bit error rate, and how many bits it changed."""
    num_flips = int(rng.binomial(8 * len(data), rate)) if rate else 0
    if not num_flips:
        return data, 0
    damaged = bytearray(data)
    for bit in rng.choice(8 * len(data), num_flips, replace=False):
        damaged[bit // 8] ^= 1 << (bit % 8)
    return bytes(damaged), num_flips


def lose_bytes(data: bytes, rate: float, rng: np.random.Generator) -> tuple[bytes, int]:
    """`data` after a line that loses bytes at this rate, and how many it lost."""
    num_lost = int(rng.binomial(len(data), rate)) if rate else 0
    if not num_lost:
        return data, 0
    rest = np.delete(np.frombuffer(data, np.uint8), rng.choice(len(data), num_lost, replace=False))
    return rest.tobytes(), num_lost
