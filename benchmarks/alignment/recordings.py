"""Simulated takes with ground truth, recorded through a mock station."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from benchmarks.simulated.hand_motions import RATE_HZ as HAND_RATE_HZ
from benchmarks.simulated.hand_motions import robot_motion
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import EpisodeAttributes, StoredAnchor
from dextouch.streams import StreamDescriptor, StreamKind
from dextouch.tactile.layout import NUM_TAXELS, SIDES
from services.acquisition.mock_station import MockTake
from services.pipelines.demo_takes import record_take

POSE_RATE_HZ, GLOVE_RATE_HZ, IMAGE_RATE_HZ = 100.0, 60.0, 30.0
IMAGE_PX = 64
K_HEAD = ((60.0, 0.0, 32.0), (0.0, 60.0, 32.0), (0.0, 0.0, 1.0))
POSES = ("wrist_left", "wrist_right", "head")
SWING_M, TURN_RAD = 0.15, 0.6

Truth = tuple[StreamDescriptor, Int64[np.ndarray, " n"], np.ndarray]


@dataclass(frozen=True)
class RecordedTake:
    """A take in a station's spool, with the ground truth that the mock devices replayed."""

    seconds: float
    take: MockTake
    truth: EpisodeReader


def record(seconds: float, seed: int, folder: Path) -> RecordedTake:
    """Record a take of a two-handed station: gloves, keypoints, poses and a camera.

    The devices have the clock drift, jitter, delays, noise and losses of `FaultScript.first_light`,
    and the gloves are calibrated with a separate take. The hands are those of the robot, so that
    the true joint angles are known; only the ground truth contains them, as `joints_measured`.
    """
    store = EpisodeStore(folder / "truth")
    rng = np.random.default_rng([seed, 1])
    streams = list(_streams(seconds, seed, rng))
    sent = [stream for stream in streams if stream[0].name != "joints_measured"]
    _write(store, "truth", streams)
    _write(store, "played", sent)
    take, _ = record_take(store.open("played"), folder / "spool", seed=seed)
    return RecordedTake(seconds, take, store.open("truth"))


def _streams(seconds: float, seed: int, rng: np.random.Generator) -> Iterator[Truth]:
    joints = []
    for side in SIDES:
        t_ns = _times_ns(seconds, HAND_RATE_HZ)
        motion = robot_motion(side, len(t_ns), seed, natural=True)
        joints.append(motion.joints_rad)
        yield _stream(f"keypoints_{side}", "keypoints", "m", t_ns, motion.keypoints_m)
        glove_ns = _times_ns(seconds, GLOVE_RATE_HZ)
        yield _stream(f"tactile_{side}", "tactile", "kPa", glove_ns, _pressures_kpa(glove_ns, rng))
    yield _stream("joints_measured", "robot_state", "rad", t_ns, np.concatenate(joints, axis=1))
    for name in POSES:
        t_ns = _times_ns(seconds, POSE_RATE_HZ)
        q_wxyz = quaternion_from_rotation(rotation_from_vector(TURN_RAD * _waves(t_ns, 3, rng)))
        poses = np.concatenate([SWING_M * _waves(t_ns, 3, rng), q_wxyz], axis=1)
        yield _stream(name, "pose", "pose_m_wxyz", t_ns, poses)
    t_ns = _times_ns(seconds, IMAGE_RATE_HZ)
    yield _stream("camera_head", "image", "rgb8", t_ns, _images(t_ns, rng))


def _stream(name: str, kind: StreamKind, unit: str, t_ns: np.ndarray, values: np.ndarray) -> Truth:
    side = next((side for side in SIDES if kind != "pose" and name.endswith(side)), None)
    descriptor = StreamDescriptor.model_validate(
        {
            "name": name,
            "kind": kind,
            "shape": values.shape[1:],
            "dtype": values.dtype.name,
            "unit": unit,
            "nominal_rate_hz": round(1e9 / (t_ns[1] - t_ns[0])),
            "side": side,
        }
    )
    return descriptor, t_ns, values


def _times_ns(seconds: float, rate_hz: float) -> Int64[np.ndarray, " n"]:
    return np.rint(np.arange(int(seconds * rate_hz) + 1) * (1e9 / rate_hz)).astype(np.int64)


def _waves(t_ns: np.ndarray, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "n k"]:
    """Sines of 0.2 to 0.7 Hz, typical frequencies of manipulation."""
    turns = rng.uniform(0.2, 0.7, num) * (t_ns[:, None] * 1e-9) + rng.random(num)
    return np.sin(2 * np.pi * turns)


def _pressures_kpa(t_ns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A contact patch that moves over the taxels, appears and disappears."""
    centre, strength = np.split(_waves(t_ns, 2, rng), 2, axis=1)
    across = (np.arange(NUM_TAXELS) - 160 - 150 * centre) / 12
    return (30 * np.maximum(strength, 0) * np.exp(-(across**2))).astype(np.float32)


def _images(t_ns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A striped pattern that moves and changes its colours."""
    stripes = np.linspace(0, 3, IMAGE_PX)[:, None, None] + np.arange(3) / 3
    turns = rng.random() + 0.7 * t_ns[:, None, None, None] * 1e-9 + stripes
    rows = np.rint(128 + 100 * np.sin(2 * np.pi * turns)).astype(np.uint8)
    return np.repeat(rows, IMAGE_PX, axis=2)


def _write(store: EpisodeStore, episode_id: str, streams: list[Truth]) -> None:
    starts = {s.name: transform_from_pose(v[0]) for s, _, v in streams if s.kind == "pose"}
    attributes = EpisodeAttributes(
        episode_id=episode_id,
        task="move",
        instruction="move both hands",
        domain="human",
        origin="twin",
        anchor=StoredAnchor.from_poses(AnchorPoses(*(starts[name] for name in POSES))),
        K_head=K_HEAD,
    )
    with store.writer(kind="episode", attributes=attributes) as writer:
        for stream, t_ns, values in streams:
            writer.add_stream(stream)
            writer.append(stream.name, values=values, t_ref_ns=t_ns)
