"""The format on disk: version 3 is read and written as ever, 2 is read, others are refused."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import CorruptDataError, StorageError
from dextouch.hands.actions import IDENTITY_POSE_9D
from dextouch.schemas import EpisodeAttributes, RecordingAttributes
from dextouch.streams import StreamDescriptor, encoded_values
from tests.unit.episodes.hostile_group import stamp_version

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
VIDEO = StreamDescriptor(
    name="camera_head",
    kind="image",
    shape=(16, 32, 3),
    dtype="uint8",
    unit="h264",
    nominal_rate_hz=30,
)
VIDEO_VALUES = (
    np.arange(11)[:, None, None, None] * 9
    + np.arange(16)[:, None, None] * 4
    + np.arange(32)[:, None] * 2
    + np.array([0, 20, 40])
).astype("u1")
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
        writer.append(
            "camera_head", values=encoded_values([image] * 2), t_ref_ns=np.array([0, 10**9])
        )
        writer.append("action", values=ACTIONS, t_ref_ns=np.arange(3) * 500_000_000)


def write_video(store):
    attributes = EpisodeAttributes.model_validate(
        {
            "episode_id": "video",
            "task": "stand_bottle",
            "instruction": "",
            "domain": "robot",
            "origin": "twin",
            "anchor": dict.fromkeys(
                ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head"), IDENTITY_ROWS
            ),
            "K_head": ((4, 0, 2), (0, 4, 2), (0, 0, 1)),
            "streams": (VIDEO,),
        }
    )
    with store.writer(attributes=attributes) as writer:
        writer.append("camera_head", values=VIDEO_VALUES, t_ref_ns=np.arange(11) * 33_333_333)


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


@pytest.fixture(params=[2, 3])
def golden(request):
    return EpisodeStore(GOLDEN / f"store_v{request.param}")


def check_content(store):
    reader = store.open("golden")
    reader.verify()
    np.testing.assert_array_equal(reader.read("force").values, FORCE_VALUES)
    window = reader.window(0, 3)
    assert window.images["camera_head"].shape == (3, 4, 4, 3)
    assert window.image_dt_ns["camera_head"].tolist() == [0, -500_000_000, 0]
    image = (GOLDEN / "image.jpg").read_bytes()
    assert reader.encoded_images("camera_head", 0, 2) == [image] * 2
    recording = store.recording("golden")
    recording.verify()
    assert recording.read("force").sequence.tolist() == [9, 10, 11, 12, 13]
    assert recording.read("force").t_device_ns.tolist() == [-1] * 5


def test_versions_are_read(golden):
    check_content(golden)


def test_both_versions_have_the_same_content():
    """Each array of numbers, and the groups of images, have one hash in both."""
    old, new = (EpisodeStore(GOLDEN / f"store_v{version}") for version in (2, 3))
    for before, after in ((old.open("golden"), new.open("golden")),):
        entries = after._contents.entries
        for name, entry in before._contents.entries.items():
            assert entries[name].sha256 == entry.sha256, name
    assert old.recording("golden").content() == new.recording("golden").content()


def test_version_3_is_still_written(store):
    """Byte for byte except the shards, whose compressed bytes are zstd's own affair."""
    golden = EpisodeStore(GOLDEN / "store_v3")
    write_episode(store)
    write_recording(store)
    found = (path.relative_to(golden.root) for path in golden.root.rglob("*.json"))
    # Encoded video is not the same on every processor.
    files = sorted(path for path in found if "video" not in path.parts)
    assert len(files) == 15
    for path in files:
        assert (store.root / path).read_bytes() == (golden.root / path).read_bytes(), path


def test_video_is_read(golden):
    """The access units of one encoder, decoded as they were when they were written."""
    reader = golden.open("video")
    reader.verify()
    images = reader.images("camera_head")
    assert images.shape == (11, 16, 32, 3)
    assert abs(images.astype(int) - VIDEO_VALUES).mean() < 2.5
    again = reader.images("camera_head", 9, 11)
    np.testing.assert_array_equal(again, images[9:])


@pytest.mark.parametrize("kind", ["episode", "recording"])
@pytest.mark.parametrize("version", [1, 4, "3"])
def test_another_version_is_refused_with_what_to_do(tmp_path, kind, version):
    shutil.copytree(GOLDEN / "store_v3", tmp_path / "other")
    store = EpisodeStore(tmp_path / "other")
    stamp_version(store, kind, "golden", version)
    told = (
        f"{kind} golden: commit.json has format version {version!r}, expected 2 or 3; "
        "read it with the release that wrote it"
    )
    with pytest.raises(StorageError, match=f"^{re.escape(told)}$") as caught:
        store.open("golden") if kind == "episode" else store.recording("golden")
    assert not isinstance(caught.value, CorruptDataError)
    # The store lists it, so that its owner sees that it is there.
    assert "golden" in store.list(kind=kind)


def test_attributes_are_found_by_other_readers(golden):
    group = json.loads((golden.root / "episodes" / "golden" / "zarr.json").read_bytes())
    assert group["attributes"]["dextouch"]["format_version"] == 1
