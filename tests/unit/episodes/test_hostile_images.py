"""Forged pictures: groups of other numbers, headers of other sizes, parameter sets of giants."""

from pathlib import Path

import numpy as np
import pytest

from dextouch.errors import CorruptDataError, StorageError
from dextouch.images import encode_jpeg
from tests.unit.episodes.hostile_group import (
    ID,
    MEMORY_BYTES,
    STILLS,
    VIDEO,
    as_v2,
    copy_of,
    forge_attributes,
    forge_first_group,
    forge_images,
    forge_record,
    group,
    memory_bound,
    rows_of,
    write_numbers,
    written_once,
)

BOTH_VERSIONS = pytest.mark.parametrize(
    "prepare", [pytest.param(lambda folder: None, id="v3"), pytest.param(as_v2, id="v2")]
)


@pytest.fixture
def whole_store(make_episode, tmp_path_factory):
    return written_once(make_episode, tmp_path_factory)


@pytest.fixture
def store(whole_store, tmp_path):
    return copy_of(whole_store, tmp_path)


@pytest.fixture
def folder(store):
    return store.root / "episodes" / ID


@pytest.fixture
def bounded_memory():
    with memory_bound():
        yield


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(
    "forge",
    [
        lambda units: group(units, count=0),
        lambda units: group(units, count=9),
        lambda units: group(units, count=2**32 - 1),
        lambda units: group(units, lengths=[2**32 - 1] * 8),
        lambda units: group(units, lengths=[len(u) + 1 for u in units]),
        lambda units: group(units[:7]),
        lambda units: group(units[:1]) + bytes(200),
        lambda units: group([b"".join(units), *[b""] * 7]),
        lambda units: group([units[0], *[b""] * 7]) + bytes(0),
        lambda units: group([units[1], units[0], *units[2:]]),
        lambda units: group([units[0][units[0].rfind(b"\x00\x00\x01") :], *units[1:]]),
        lambda units: group([b"\x00\x00\x00\x01\x09\x10"] * 8),
        lambda units: group([bytes(100)] * 8),
        lambda units: b"\x08",
    ],
)
def test_forged_groups_of_pictures_of_version_2(store, folder, forge):
    as_v2(folder)
    assert store.open(ID).verify().num_arrays == 12
    forge_first_group(folder, forge)
    with pytest.raises(CorruptDataError, match=VIDEO):
        store.open(ID).images(VIDEO)


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(
    "forge",
    [
        lambda units: [units[1], units[0], *units[2:]],
        lambda units: [units[0][units[0].rfind(b"\x00\x00\x01") :], *units[1:]],
        lambda units: [*units[:3], *units[4:9], units[8], *units[9:]],
        lambda units: [b"\x00\x00\x00\x01\x09\x10"] * len(units),
        lambda units: [bytes(100)] * len(units),
    ],
)
def test_forged_pictures(store, folder, forge):
    assert store.open(ID).verify().num_arrays == 14
    forge_images(folder, VIDEO, forge)
    with pytest.raises(CorruptDataError, match=f"{VIDEO}.*image 0|{VIDEO}.*image 3"):
        store.open(ID).images(VIDEO)


def change(row, column, value):
    def edit(index):
        index[row, column] = value
        return index

    return edit


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("name", [VIDEO, STILLS])
@pytest.mark.parametrize(
    ("forged", "says"),
    [
        (change(0, 0, 1), "inconsistent"),
        (change(0, 0, -8), "inconsistent"),
        (change(3, 0, 0), "inconsistent"),
        (change(3, 1, 2**62), "inconsistent"),
        (change(-1, 1, 2**62), "inconsistent"),
        (change(-1, 1, -(2**62)), "inconsistent"),
        (lambda index: index[::-1].copy(), "inconsistent"),
        (lambda index: index[:1].repeat(len(index), axis=0), "inconsistent"),
        (change(5, 2, 7), "image 5: checksum"),
        (change(5, 2, -1), "image 5: checksum"),
    ],
)
def test_forged_indices(store, folder, name, forged, says):
    """With right checksums, so that nothing but the places of the images is wrong."""
    write_numbers(folder, f"{name}_index", forged(rows_of(folder, f"{name}_index").copy()))
    reader = store.open(ID)
    for read in (reader.images, lambda name: reader.encoded_images(name, 0, 8)):
        with pytest.raises(CorruptDataError, match=f"'{name}'.*{says}"):
            read(name)
    with pytest.raises(CorruptDataError, match=f"'{name}"):
        reader.verify()


def test_a_short_group_in_the_middle_shifts_nothing(store, folder):
    as_v2(folder)
    forge_first_group(folder, lambda units: group(units[:7]))
    with pytest.raises(CorruptDataError, match="holds 7 images, expected 8"):
        store.open(ID).encoded_images(VIDEO, 0, 12)


class Bits:
    """Writes the numbers of a parameter set (ITU-T H.264, 9.1)."""

    def __init__(self):
        self.text = ""

    def fixed(self, value, width):
        self.text += f"{value:0{width}b}"

    def golomb(self, *values):
        for value in values:
            self.text += "0" * ((value + 1).bit_length() - 1) + f"{value + 1:b}"

    def unit(self, header):
        text = self.text + "1"
        text += "0" * (-len(text) % 8)
        data = int(text, 2).to_bytes(len(text) // 8, "big")
        # No three bytes may look like a start code.
        while (place := data.find(b"\x00\x00")) >= 0 and place + 2 < len(data):
            if data[place + 2] > 3:
                break
            data = data[: place + 2] + b"\x03" + data[place + 2 :]
        return b"\x00\x00\x00\x01" + bytes([header]) + data


def sequence_parameters(macroblocks_wide, macroblocks_high):
    """Profile baseline, level 6.2, one reference, no cropping."""
    bits = Bits()
    for value in (66, 0xC0, 62):
        bits.fixed(value, 8)
    # id, frame numbers of 4 bits, picture order by decoding, one reference
    bits.golomb(0, 0, 2, 1)
    bits.fixed(0, 1)
    bits.golomb(macroblocks_wide - 1, macroblocks_high - 1)
    for flag in (1, 1, 0, 0):
        bits.fixed(flag, 1)
    return bits.unit(0x67)


def peak_bytes():
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024


@BOTH_VERSIONS
@pytest.mark.parametrize(("wide", "high"), [(1024, 1024), (1024, 4), (8, 8), (4, 5)])
def test_video_that_announces_another_size(store, folder, wide, high, prepare):
    """16,384 x 16,384 pixels would be 400 MB an image."""
    prepare(folder)
    true = store.open(ID).images(VIDEO, 8, 16)

    def forge(units):
        start = b"\x00\x00\x00\x01"
        kept = [part for part in units[0].split(start) if part and part[0] & 0x1F != 7]
        first = sequence_parameters(wide, high) + b"".join(start + part for part in kept)
        return [first, *units[1:]]

    forge_images(folder, VIDEO, forge)
    Path("/proc/self/clear_refs").write_text("5")
    before = peak_bytes()
    reader = store.open(ID)
    with pytest.raises(CorruptDataError, match=VIDEO):
        reader.images(VIDEO, 0, 8)
    assert peak_bytes() - before < MEMORY_BYTES
    # The decoder of this thread is as good as new.
    np.testing.assert_array_equal(reader.images(VIDEO, 8, 16), true)


@BOTH_VERSIONS
@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("shape", [(64, 65), (65, 64), (1, 1), (128, 128)])
def test_a_jpeg_of_another_size(store, folder, shape, prepare):
    prepare(folder)
    image = encode_jpeg(np.full((*shape, 3), 90, np.uint8))
    forge_images(folder, STILLS, lambda images: [image, *images[1:]])
    with pytest.raises(CorruptDataError, match=r"image 0: .*expected .64, 64."):
        store.open(ID).images(STILLS)


@BOTH_VERSIONS
def test_a_jpeg_that_announces_much_and_holds_little(store, folder, prepare):
    prepare(folder)
    whole = store.open(ID).encoded_images(STILLS, 0, 1)[0]
    for forged in (whole[:-80], whole[: len(whole) // 2], b"\xff\xd8\xff", b"x"):
        forge_images(folder, STILLS, lambda images, forged=forged: [forged, *images[1:]])
        with pytest.raises(CorruptDataError, match="image 0: "):
            store.open(ID).images(STILLS)


# Of the pictures that a stream may have, the first is larger than H.264 knows.
@pytest.mark.parametrize(
    ("size", "says"),
    [(6144, "pixels, expected at most"), (8388608, "bytes, expected at most")],
)
def test_images_larger_than_any_are_refused_before_they_are_made(store, folder, size, says):
    data = (folder / "zarr.json").read_bytes()
    shape = f'"shape":[{size},{size},3]'.encode()
    forge_attributes(folder, data.replace(b'"shape":[64,64,3]', shape))
    # That of images of so many pixels.
    forge_record(
        folder,
        lambda record: [record["arrays"][n].update(chunk_rows=65536) for n in (VIDEO, STILLS)],
    )
    with pytest.raises(StorageError, match=says):
        store.open(ID)
