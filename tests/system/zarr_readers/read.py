"""Reads one group of the episode store with zarr-python, xarray and tensorstore, without dextouch.

Run it with the Python of an environment that has only those: `read.py GROUP TRUTH
[xarray] [tensorstore]`.
TRUTH is an .npz of what the arrays hold and of the decoded images (`pixels/CAMERA`), of which
`write_truth` in tests/unit/episodes/test_interop.py is the source. Every warning is an error.
"""

import io
import sys
import warnings
from pathlib import Path

import numpy as np
import zarr

# Where it is installed, it must not be used either: neither by us nor by zarr's entry points.
sys.modules["dextouch"] = None


def check(got, true, what):
    got = np.asarray(got)
    assert (got.dtype, got.shape) == (true.dtype, true.shape), (what, got.dtype, got.shape)
    assert got.tobytes() == true.tobytes(), what


def encoded_images(data, index):
    """By the description of the format: image i is data[index[i, 0] : index[i, 1]]."""
    return [data[start:stop].tobytes() for start, stop, _ in index.tolist()]


def jpeg_pixels(images):
    from PIL import Image

    return np.stack([np.asarray(Image.open(io.BytesIO(image))) for image in images])


def h264_pixels(images):
    import av

    decoder = av.CodecContext.create("h264", "r")
    packets = [av.Packet(image) for image in images]
    frames = [frame for packet in [*packets, None] for frame in decoder.decode(packet)]
    formed = [f.reformat(format="rgb24", interpolation="BICUBIC") for f in frames]
    return np.stack([frame.to_ndarray() for frame in formed])


PIXELS = {"jpeg": jpeg_pixels, "h264": h264_pixels}


def read_with_zarr(group_path, truth):
    group = zarr.open_group(group_path, mode="r")
    arrays = dict(group.arrays())
    assert sorted(group.keys()) == sorted(arrays) == sorted(n for n in truth if "/" not in n)
    for name, array in arrays.items():
        check(array[:], truth[name], name)
    assert group.attrs["dextouch"]["streams"]
    decoded = []
    for name, array in arrays.items():
        if codec := array.attrs.get("encoding"):
            index = arrays[array.attrs["index"]][:]
            pixels = PIXELS[codec](encoded_images(array[:], index))
            # Scaling chroma is left to a library: one step of 256 at most between two versions.
            far = np.abs(pixels.astype(int) - truth[f"pixels/{name}"]).max()
            assert far <= 1, (name, far)
            decoded.append(f"{name} ({codec}, {far} off)")
    print(f"zarr-python {zarr.__version__}: {len(arrays)} arrays; {', '.join(decoded)}")


def read_with_xarray(group_path, truth):
    import xarray

    for options in ({}, {"consolidated": True}, {"chunks": None}):
        with xarray.open_zarr(group_path, **options) as data:
            assert set(data.variables) == {n for n in truth if "/" not in n}
            for name in data.variables:
                check(data[name].values, truth[name], name)
    with xarray.open_dataset(group_path, engine="zarr") as data:
        touch = data["tactile_left"]
        first = touch.dims[0]
        assert first in touch.coords, touch.coords
        assert touch.attrs["units"] == "kPa"
        assert data[first].attrs["units"] == "ns"
        # Selected by time.
        times = data[first].values
        check(touch.sel({first: slice(times[3], times[7])}).values, truth["tactile_left"][3:8], "")
    print(f"xarray {xarray.__version__}: {len(data.variables)} variables")


def read_with_tensorstore(group_path, truth):
    import tensorstore

    for name, true in truth.items():
        if "/" not in name:
            spec = {
                "driver": "zarr3",
                "kvstore": {"driver": "file", "path": f"{group_path}/{name}"},
            }
            array = tensorstore.open(spec, read=True, open=True).result()
            check(array.read().result(), true, name)
    print("tensorstore: all arrays")


def main(group_path, truth_path, *libraries):
    with np.load(truth_path) as file:
        truth = dict(file)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_with_zarr(Path(group_path), truth)
        if "xarray" in libraries:
            read_with_xarray(Path(group_path), truth)
        if "tensorstore" in libraries:
            read_with_tensorstore(Path(group_path), truth)


if __name__ == "__main__":
    main(*sys.argv[1:])
