"""Taxel layout: what goes out comes back, and left mirrors right."""

import numpy as np
import pytest

from dextouch.errors import ShapeError, UnknownNameError
from dextouch.streams import StreamDescriptor
from dextouch.tactile import layout
from services.acquisition.mocks.gloves import GloveCalibration, TactileGloveSource
from services.acquisition.mocks.replay import ReplayStream
from tests.unit.other_gloves import small_layout


@pytest.mark.parametrize("side", layout.SIDES)
def test_select_inverts_expand(side):
    taxels = np.arange(2 * 320).reshape(2, 320)
    raw = layout.expand_taxels(taxels, side=side)
    assert raw.shape == (2, 360)
    np.testing.assert_array_equal(layout.select_taxels(raw, side=side), taxels)
    assert len(set(layout.DEXTOUCH_V1.raw_indices(side=side).tolist())) == 320


# Scan row and column of some taxels of the right glove, counted by hand from the wiring in
# docs/device_packets.md: pad, row and column within the pad, scan row, scan column.
WIRING = [
    ("thumb", 0, 0, 0, 0),
    ("thumb", 0, 3, 0, 3),
    ("thumb", 3, 0, 3, 0),
    ("index", 1, 2, 1, 6),
    ("ring", 2, 0, 2, 12),
    ("little", 3, 3, 3, 19),
    ("palm", 0, 0, 4, 0),
    ("palm", 0, 15, 4, 15),
    ("palm", 1, 0, 4, 16),
    ("palm", 1, 4, 5, 0),
    ("palm", 14, 15, 15, 19),
]


@pytest.mark.parametrize("side", layout.SIDES)
@pytest.mark.parametrize(("pad", "row", "column", "scan_row", "scan_column"), WIRING)
def test_each_pad_is_read_from_its_place_in_the_scan(side, pad, row, column, scan_row, scan_column):
    scan = np.zeros((18, 20))
    scan[scan_row, scan_column if side == "right" else 19 - scan_column] = 1.0
    tips, palm = layout.split_pads(layout.select_taxels(scan.ravel(), side=side))
    pads = {**dict(zip(layout.FINGERS, tips, strict=True)), "palm": palm}
    assert [name for name in pads if pads[name].any()] == [pad]
    assert np.argwhere(pads[pad]).tolist() == [[row, column]]


def scan_cell(pad, row, column, *, side):
    """Place in the 360 readings by the table "Scan of the tactile glove", one taxel at a time."""
    if pad == "palm":
        number = 16 * row + column
        scan_row, scan_column = 4 + number // 20, number % 20
    else:
        first_column = {"thumb": 0, "index": 4, "middle": 8, "ring": 12, "little": 16}[pad]
        scan_row, scan_column = row, first_column + column
    return 20 * scan_row + (scan_column if side == "right" else 19 - scan_column)


def all_taxels():
    """Pad, row and column of the 320 taxels in anatomical order."""
    for pad in ("thumb", "index", "middle", "ring", "little"):
        yield from ((pad, row, column) for row in range(4) for column in range(4))
    yield from (("palm", row, column) for row in range(15) for column in range(16))


@pytest.mark.parametrize("side", ["left", "right"])
def test_every_taxel_is_read_from_the_documents_cell(side):
    readings = 1000 + np.arange(360)
    expected = [1000 + scan_cell(*taxel, side=side) for taxel in all_taxels()]
    assert layout.select_taxels(readings, side=side).tolist() == expected


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_mock_glove_sends_every_taxel_in_the_documents_cell(side):
    kpa = np.arange(1, 321, dtype=np.float32)
    glove = GloveCalibration(np.zeros(360), np.full(360, 10.0))
    sent = np.frombuffer(packet_of(kpa, glove, side)[22:-4], "<u2")
    for taxel, pressure in zip(all_taxels(), kpa, strict=True):
        assert sent[scan_cell(*taxel, side=side)] == 10 * pressure
    assert np.count_nonzero(sent) == 320


def packet_of(kpa, glove, side):
    """The bytes that a mock glove sends of one sample."""
    descriptor = StreamDescriptor(
        name=f"tactile_{side}",
        kind="tactile",
        shape=(320,),
        dtype="float32",
        unit="kPa",
        nominal_rate_hz=60,
    )
    stream = ReplayStream(descriptor, np.zeros(1, dtype=np.int64), kpa[None])
    (packet,) = TactileGloveSource(stream, side=side, calibration=glove).units(0, 0, 0)
    return packet


def test_the_cells_around_the_taxels_are_zero_and_the_type_stays():
    raw = layout.expand_taxels(np.full(320, 7, dtype=np.uint16), side="left")
    assert raw.dtype == np.uint16
    assert np.bincount(raw).tolist() == [40, 0, 0, 0, 0, 0, 0, 320]


def test_taxels_of_the_palm_are_larger_than_those_of_the_fingertips():
    """4 by 4 mm, and 6 by 5 mm in the palm."""
    areas = layout.DEXTOUCH_V1.areas_m2
    np.testing.assert_allclose(areas[:80], 16e-6)
    np.testing.assert_allclose(areas[80:], 30e-6)


def test_left_glove_is_wired_as_the_mirror_image():
    left = layout.DEXTOUCH_V1.raw_indices(side="left").reshape(-1)
    right = layout.DEXTOUCH_V1.raw_indices(side="right").reshape(-1)
    np.testing.assert_array_equal(left // 20, right // 20)
    np.testing.assert_array_equal(left % 20, 19 - right % 20)


def test_pads_round_trip():
    taxels = np.random.default_rng(0).normal(size=(3, 2, 320))
    tips, palm = layout.split_pads(taxels)
    assert tips.shape == (3, 2, 5, 4, 4)
    assert palm.shape == (3, 2, 15, 16)
    np.testing.assert_array_equal(layout.join_pads(tips, palm), taxels)


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match="360"):
        layout.select_taxels(np.zeros(320), side="left")
    with pytest.raises(UnknownNameError, match="dextouch_v1"):
        layout.select_taxels(np.zeros(360), side="left", glove_model="other")


def test_contact_threshold_is_two_kilopascal():
    assert layout.in_contact(np.array([1.99, 2.0, np.nan])).tolist() == [False, True, False]


def test_hand_canvas_holds_every_taxel_once_and_mirrors():
    taxels = np.arange(1, 321, dtype=np.float32)
    right = layout.DEXTOUCH_V1.hand_canvas(taxels, side="right")
    assert sorted(right[np.isfinite(right)].tolist()) == taxels.tolist()
    left = layout.DEXTOUCH_V1.hand_canvas(taxels, side="left")
    np.testing.assert_array_equal(left, right[:, ::-1])
    rgb = layout.colour(right)
    assert rgb.shape == (28, 26, 3)
    assert (rgb[np.isnan(right)] == rgb[0, 0]).all()


@pytest.mark.parametrize("shape", [(), (16,), (15, 15), (2, 16, 15)])
def test_pads_of_other_shapes_are_not_joined(shape):
    with pytest.raises(ShapeError, match=r"palm: got shape .*, expected \[\.\.\., 15, 16\]"):
        layout.join_pads(np.zeros((5, 4, 4)), np.zeros(shape))


@pytest.mark.parametrize("unit", ["N", "kPa"])
def test_facts_of_a_layout_cannot_be_changed(unit):
    glove = small_layout(unit=unit)
    for fact in (layout.DEXTOUCH_V1.areas_m2, glove.areas_m2, glove.nominal_kpa_per_unit):
        with pytest.raises(ValueError, match="read-only"):
            fact[0] = 1.0
