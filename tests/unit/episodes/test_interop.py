"""Other readers of Zarr v3 see the same numbers, bit for bit, without our code."""

import numpy as np
import pytest
import zarr

tensorstore = pytest.importorskip("tensorstore", reason="tensorstore is not installed")


@pytest.fixture
def folder(make_episode, store):
    made = make_episode(camera_unit="h264")
    made.write(store)
    return made, store.root / "episodes" / made.attributes.episode_id


def numeric_arrays(made):
    arrays = {f"{name}_t_ref_ns": stamps for name, stamps in made.stamps_ns.items()}
    cameras = {d.name for d in made.descriptors if d.kind == "image"}
    return arrays | {name: v for name, v in made.values.items() if name not in cameras}


def check_equal(got, true):
    got = np.asarray(got)
    assert got.dtype == true.dtype
    assert got.shape == true.shape
    assert got.tobytes() == true.tobytes()


def test_zarr_python_reads_the_numbers(folder):
    made, path = folder
    group = zarr.open_group(path, mode="r")
    for name, true in numeric_arrays(made).items():
        check_equal(group[name][:], true)


def test_tensorstore_reads_the_numbers(folder):
    made, path = folder
    for name, true in numeric_arrays(made).items():
        spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(path / name)}}
        array = tensorstore.open(spec, read=True, open=True).result()
        check_equal(array.read().result(), true)
        assert array.domain.labels[0].endswith("_time")


# zarr-python says so of every file in a group that is no array; the commit record is one.
@pytest.mark.filterwarnings("ignore:Object at commit.json is not recognized")
def test_xarray_lines_streams_up_by_name(folder, store):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    made, path = folder
    with xarray.open_zarr(path, consolidated=False) as data:
        for name, true in numeric_arrays(made).items():
            check_equal(data[name].values, true)
            assert data[name].dims[0] == f"{name.removesuffix('_t_ref_ns')}_time"
        images = store.open(made.attributes.episode_id).images("camera_head")
        check_equal(data["camera_head"].values, images)
