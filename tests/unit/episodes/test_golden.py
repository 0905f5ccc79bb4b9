"""Format v1 as it lies on disk: what version 1 once wrote must always be read, and be the same."""

import json
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.hands.actions import IDENTITY_POSE_9D
from dextouch.images.jpeg import jpeg_values
from dextouch.schemas.episodes import EpisodeAttributes
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.descriptors import StreamDescriptor

GOLDEN = Path(__file__).parents[2] / "golden"
FORCE = StreamDescriptor(
    name="force", kind="scalar", shape=(2,), dtype="float32", unit="N", nominal_rate_hz=4
)
CAMERA = StreamDescriptor(
    name="camera_head",
    kind="image",
    shape=(4, 4, 3),
    dtype="uint8",
    unit="jpeg",
    nominal_rate_hz=2,
)
ACTION = StreamDescriptor(
    name="action",
    kind="robot_state",
    shape=(67,),
    dtype="float64",
    unit="action",
    nominal_rate_hz=2,
)
FORCE_VALUES = np.arange(10, dtype="f4").reshape(5, 2) / 4
ACTIONS = np.concatenate(
    [np.tile(IDENTITY_POSE_9D, (3, 2)), np.zeros((3, 40)), np.tile(IDENTITY_POSE_9D, (3, 1))],
    axis=1,
)
IDENTITY_ROWS = tuple(tuple(float(i == j) for j in range(4)) for i in range(4))


def write_episode(store):
    attributes = EpisodeAttributes.model_validate(
        {
            "episode_id": "golden",
            "task": "stand_bottle",
            "instruction": "stand the bottle up",
            "domain": "robot",
            "origin": "twin",
            "seed": 7,
            "model_rate_hz": 2.0,
            "anchor": dict.fromkeys(
                ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head"), IDENTITY_ROWS
            ),
            "K_head": ((4, 0, 2), (0, 4, 2), (0, 0, 1)),
            "success": True,
            "streams": (FORCE, CAMERA, ACTION),
        }
    )
    image = (GOLDEN / "image.jpg").read_bytes()
    with store.writer(attributes=attributes) as writer:
        writer.append("force", values=FORCE_VALUES, t_ref_ns=np.arange(5) * 250_000_000)
        writer.append("camera_head", values=jpeg_values([image] * 2), t_ref_ns=np.array([0, 10**9]))
        writer.append("action", values=ACTIONS, t_ref_ns=np.arange(3) * 500_000_000)


def write_recording(store):
    attributes = RecordingAttributes(
        recording_id="golden",
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        streams=(FORCE,),
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.append(
            "force", values=FORCE_VALUES, t_host_ns=np.arange(5), sequence=np.arange(5) + 9
        )


@pytest.fixture
def golden():
    return EpisodeStore(GOLDEN / "store_v1")


def test_version_1_is_read(golden):
    reader = golden.open("golden")
    reader.verify()
    np.testing.assert_array_equal(reader.read("force").values, FORCE_VALUES)
    window = reader.window(0, 3)
    assert window.images["camera_head"].shape == (3, 4, 4, 3)
    assert window.image_dt_ns["camera_head"].tolist() == [0, -500_000_000, 0]
    recording = golden.recording("golden")
    recording.verify()
    assert recording.read("force").sequence.tolist() == [9, 10, 11, 12, 13]
    assert recording.read("force").t_device_ns.tolist() == [-1] * 5


def test_version_1_is_still_written(golden, store):
    """Byte for byte except the shards, whose compressed bytes are zstd's own affair."""
    write_episode(store)
    write_recording(store)
    files = sorted(path.relative_to(golden.root) for path in golden.root.rglob("*.json"))
    assert len(files) == 15
    for path in files:
        assert (store.root / path).read_bytes() == (golden.root / path).read_bytes(), path


def test_attributes_are_found_by_other_readers(golden):
    group = json.loads((golden.root / "episodes" / "golden" / "zarr.json").read_bytes())
    assert group["attributes"]["dextouch"]["format_version"] == 1
