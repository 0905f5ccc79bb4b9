"""Other readers of Zarr v3 list and read a group with encoded cameras without our code."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zarr

from dextouch.episodes import EpisodeStore
from tests.unit.episodes.hostile_group import rows_of

READERS = Path(__file__).parents[2] / "system" / "zarr_readers" / "read.py"
UNITS = {"camera_head": "h264", "camera_wrist_left": "jpeg", "camera_wrist_right": "rgb8"}


def write_truth(made, store, path):
    """An episode with three kinds of cameras, and what its arrays hold, as they were given."""
    made.descriptors = [
        d.model_copy(update={"unit": UNITS.get(d.name, d.unit)}) for d in made.descriptors
    ]
    reader = made.write(store)
    folder = store.root / "episodes" / made.attributes.episode_id
    truth = {f"{name}_t_ref_ns": stamps for name, stamps in made.stamps_ns.items()}
    for name, values in made.values.items():
        truth[name] = values
        if UNITS.get(name) in {"jpeg", "h264"}:
            images = reader.encoded_images(name, 0, len(values))
            truth[name] = np.frombuffer(b"".join(images), np.uint8)
            truth[f"{name}_index"] = rows_of(folder, f"{name}_index")
            truth[f"pixels/{name}"] = reader.images(name)
    np.savez(path, **truth)
    return folder


@pytest.mark.parametrize("library", ["zarr", "xarray", "tensorstore"])
def test_a_group_with_encoded_cameras_is_listed_and_read(make_episode, store, tmp_path, library):
    pytest.importorskip(library, reason=f"{library} is not installed")
    folder = write_truth(make_episode(), store, tmp_path / "truth.npz")
    # Our package is in this environment, too: the script blocks it.
    ran = subprocess.run(
        [sys.executable, str(READERS), str(folder), str(tmp_path / "truth.npz"), library],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert library in ran.stdout


def test_a_recording_is_listed_with_its_other_stamps_as_coordinates(tmp_path):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    golden = EpisodeStore(Path(__file__).parents[2] / "golden" / "store_v3")
    with xarray.open_zarr(golden.root / "recordings" / "golden") as data:
        assert set(data.data_vars) == {"force"}
        assert set(data["force"].coords) == {
            "force_t_host_ns",
            "force_t_device_ns",
            "force_sequence",
        }
        assert data["force_sequence"].values.tolist() == [9, 10, 11, 12, 13]
        assert data["force"].attrs["long_name"] == "force"


@pytest.mark.parametrize("unit", ["days", "seconds", "hours since 2020-01-01"])
def test_units_that_xarray_would_take_for_times_are_left_out(store, unit):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    from tests.unit.episodes.test_store import recording_attributes, scalar_stream

    with store.writer(kind="recording", attributes=recording_attributes()) as writer:
        writer.add_stream(scalar_stream(unit=unit))
        writer.append("force", values=np.ones((3, 2), "f4"), t_host_ns=np.arange(3))
    with xarray.open_zarr(store.root / "recordings" / "take-1") as data:
        assert data["force"].dtype == np.float32


@pytest.mark.parametrize("item", ["golden", "video"])
def test_zarr_python_reads_images_of_version_2_through_our_codecs(item):
    golden = EpisodeStore(Path(__file__).parents[2] / "golden" / "store_v2")
    group = zarr.open_group(golden.root / "episodes" / item, mode="r")
    images = golden.open(item).images("camera_head")
    np.testing.assert_array_equal(group["camera_head"][:], images)
