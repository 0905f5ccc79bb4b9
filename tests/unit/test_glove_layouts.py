"""Layouts of gloves from files: their bytes, forces and pictures, and what is refused."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from dextouch.errors import InvalidInputError, LimitExceededError, NotFoundError, ShapeError
from dextouch.metrics import tactile as tactile_metrics
from dextouch.streams import StreamDescriptor
from dextouch.tactile import DEXTOUCH_V1, TactileLayout, read_layout
from dextouch.tactile.layout import common_layout
from services.acquisition.clock import StationClock
from services.acquisition.devices.justfloat_glove import JustFloatGloveDecoder
from services.acquisition.devices.kinds import build_drivers, device_kind
from services.acquisition.devices.tactile_glove import TactileGloveDecoder
from services.acquisition.devices.wuji_glove import WujiGloveDecoder
from services.acquisition.health.cells import cell_judge
from services.acquisition.health.glove_records import glove_record, mapped_cells
from services.acquisition.health.station import needed_matrices
from services.acquisition.mocks.gloves import (
    GloveCalibration,
    JustFloatGloveSource,
    TactileGloveSource,
)
from services.acquisition.mocks.replay import ReplayStream
from services.alignment.calibration.tactile_gain import TaxelPress, calibrate_glove
from services.alignment.calibration.tactile_tare import TactileCalibration, measure_tare
from tests.unit.acquisition.health_blocks_made import SECOND_NS, block, judged
from tests.unit.other_gloves import PALM_AREA_M2, TIP_AREA_M2, small_layout

EXAMPLE = Path(__file__).parents[2] / "shared/dextouch/tactile/example_138.json"
AREAS_M2 = np.array([TIP_AREA_M2] * 75 + [PALM_AREA_M2] * 63)


def written(tmp_path, **changes):
    """A file with the example's layout, changed."""
    path = tmp_path / "glove.json"
    path.write_text(json.dumps(json.loads(EXAMPLE.read_text()) | changes))
    return path


def played(layout, kpa):
    descriptor = StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=(138,),
        dtype="float32",
        unit="kPa",
        nominal_rate_hz=50,
        side="left",
        layout=layout,
    )
    t_ns = np.arange(len(kpa), dtype=np.int64) * 20_000_000
    return ReplayStream(descriptor, t_ns, kpa.astype(np.float32))


@pytest.mark.parametrize("side", ["left", "right"])
def test_newtons_travel_in_the_cells_of_the_wiring(side):
    """Bytes of the mock and readings of the driver against a loop over the layout's own table."""
    layout = small_layout(seed=11)
    wiring = getattr(layout.raw_cells, side)
    assert sorted(wiring) != list(wiring)
    kpa = np.random.default_rng(0).uniform(0, 45, (3, 138)).astype(np.float32)
    source = JustFloatGloveSource(played(layout, kpa), side=side)
    decoder = JustFloatGloveDecoder(
        side, num_values=150, full_scale=4.0, rate_hz=50.0, layout=layout
    )
    data = b"".join(unit for index in range(3) for unit in source.units(index, 0, 0))
    numbers = struct.unpack("<150f", data[:600])
    for taxel, cell in enumerate(wiring):
        assert numbers[cell] == pytest.approx(kpa[0, taxel] * 1000 * AREAS_M2[taxel], rel=1e-6)
    assert sum(number != 0 for number in numbers) == 138
    samples = decoder.feed(data[-604:] + data)
    (descriptor,) = decoder.descriptors
    assert (descriptor.unit, descriptor.shape, descriptor.layout) == ("N", (150,), layout)
    record = {f"tactile_{side}_tare_counts": ((0.0,) * 150,)}
    glove = TactileCalibration.from_record(record, side, layout=layout)
    values = np.stack([sample.values for sample in samples[-2:]])
    np.testing.assert_allclose(glove.to_kpa(values), kpa[-2:], rtol=1e-5)
    live = glove_record(descriptor, record)
    read = (values[1] / live.gain_counts_per_kpa)[live.cells]
    np.testing.assert_allclose(read, kpa[-1], rtol=1e-5)


def test_counts_travel_in_our_packets():
    layout = small_layout(unit="counts", full_scale=4095.0)
    gain = np.random.default_rng(1).uniform(20, 40, 150)
    kpa = np.random.default_rng(2).uniform(0, 45, (1, 138)).astype(np.float32)
    calibration = GloveCalibration(np.full(150, 100.0), gain, layout)
    source = TactileGloveSource(played(layout, kpa), side="left", calibration=calibration)
    (packet,) = source.units(0, 0, 0)
    # Header of 22 bytes (docs/device_packets.md), 150 × u16, CRC of 4.
    assert len(packet) == 22 + 300 + 4
    counts = struct.unpack("<150H", packet[22:-4])
    for taxel, cell in enumerate(layout.raw_cells.left):
        assert counts[cell] == round(100 + gain[cell] * float(kpa[0, taxel]))
    (sample,) = TactileGloveDecoder("left", layout=layout).feed(packet)
    np.testing.assert_array_equal(sample.values, counts)


def test_forces_metrics_and_pictures_follow_the_pads():
    layout, rng = small_layout(), np.random.default_rng(4)
    kpa = rng.uniform(0, 20, (2, 138))
    pressed = np.where(kpa >= 2, kpa, 0) * 1000 * AREAS_M2
    expected = [[row[15 * tip : 15 * tip + 15].sum() for tip in range(5)] for row in pressed]
    forces = layout.pad_forces_n(kpa)
    np.testing.assert_allclose(forces[:, :5], expected)
    np.testing.assert_allclose(forces[:, 5], pressed[:, 75:].sum(axis=1))
    canvas = layout.hand_canvas(np.arange(1, 139), side="right")
    # Thumb at row 7, column 20: radial on the right. Palm at row 11, column 7.
    assert canvas[7, 20:25].tolist() == [5, 4, 3, 2, 1]
    assert canvas[11 + 6, 7] == 138
    mirrored = layout.hand_canvas(np.arange(1, 139), side="left")
    np.testing.assert_array_equal(mirrored, canvas[:, ::-1])
    both = {"predicted_kpa": kpa, "true_kpa": kpa, "layout": layout}
    assert tactile_metrics.ssim(**both) == pytest.approx(1)
    assert tactile_metrics.pad_contact_f1(**both) == 1
    with pytest.raises(ShapeError, match="138"):
        tactile_metrics.mse(predicted_kpa=kpa[:, :100], true_kpa=kpa[:, :100], layout=layout)


def test_a_part_without_taxels_has_no_force():
    plain = small_layout().model_dump()
    plain["pads"] = [plain["pads"][1], plain["pads"][5]]
    plain["raw_cells"] = {side: cells[:78] for side, cells in plain["raw_cells"].items()}
    layout = TactileLayout.model_validate(plain)
    forces = layout.pad_forces_n(np.full((1, 78), 10.0))
    np.testing.assert_allclose(forces, [[0, 0.12 * 15, 0, 0, 0, 0.8 * 63]])


def test_the_example_is_what_its_document_says():
    layout = read_layout(EXAMPLE)
    assert [pad.shape for pad in layout.pads] == [(3, 5)] * 5 + [(7, 9)]
    assert (layout.num_taxels, layout.unit, layout.nominal_rate_hz) == (138, "N", 50)
    right = np.array(layout.raw_cells.right)
    # 15 scan columns, the left glove mirrored; the thumb's second row is in scan row 1.
    np.testing.assert_array_equal(layout.raw_cells.left, 15 * (right // 15) + 14 - right % 15)
    assert right[5] == 15


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": None}, "unit: got None"),
        ({"colour": "red"}, "colour: got 'red', expected: Extra inputs"),
        ({"range_kpa": -1}, "range_kpa: got -1, expected: .*greater than 0"),
        ({"num_raw_cells": 138}, r"raw_cells.left: got cell 149 for taxel 135, expected 0 … 137"),
        ({"raw_cells": {"left": [0], "right": [0]}}, "raw_cells.left: got 1 cells, expected 138"),
        (
            {"raw_cells": {"left": [7] * 138, "right": [7] * 138}},
            r"raw_cells.left: got cell 7 for 138 taxels, expected a cell of its own",
        ),
        ({"canvas": [18, 24]}, r"pads: thumb of \(3, 5\) at \(7, 20\) ends outside of the canvas"),
        ({"canvas": [4096, 4096]}, "canvas: got .*expected at most 4096 cells"),
        ({"kpa_per_unit": 0.1}, "kpa_per_unit: got 0.1 for the unit 'N', whose scale is known"),
        ({"pads": []}, "pads: got "),
    ],
)
def test_a_bad_file_is_refused_by_field(tmp_path, changes, message):
    path = written(tmp_path, **changes)
    with pytest.raises(InvalidInputError, match=f"glove.json: {message}"):
        read_layout(path)


def test_pads_are_named_once_and_do_not_overlap(tmp_path):
    pads = json.loads(EXAMPLE.read_text())["pads"]
    with pytest.raises(InvalidInputError, match="each part at most once, in the order thumb"):
        read_layout(written(tmp_path, pads=[pads[1], pads[0], *pads[2:]]))
    with pytest.raises(InvalidInputError, match=r"index at .* lies over another pad"):
        read_layout(written(tmp_path, pads=[pads[0], pads[1] | {"origin": [7, 20]}, *pads[2:]]))
    with pytest.raises(InvalidInputError, match=r"pads\.0\.taxel_area_m2: got 0, expected"):
        read_layout(written(tmp_path, pads=[pads[0] | {"taxel_area_m2": 0}, *pads[1:]]))


def test_files_that_are_no_layout_are_refused(tmp_path):
    with pytest.raises(NotFoundError, match="no such file"):
        read_layout(tmp_path / "none.json")
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InvalidInputError, match=r"a\.json: got .*Invalid JSON"):
        read_layout(tmp_path / "a.json")
    (tmp_path / "b.json").write_bytes(b" " * 300_000)
    with pytest.raises(LimitExceededError, match="262144 bytes"):
        read_layout(tmp_path / "b.json")


def test_streams_of_our_glove_name_no_layout():
    (descriptor,) = TactileGloveDecoder("left").descriptors
    assert "layout" not in descriptor.model_dump_json()
    assert descriptor.tactile_layout is DEXTOUCH_V1
    other = descriptor.model_dump() | {"layout": small_layout()}
    with pytest.raises(ValidationError, match=r"got a tactile stream with samples of \(360,\)"):
        StreamDescriptor.model_validate(other)


def test_equal_layouts_are_one_and_others_are_named():
    one, same, other = small_layout(), small_layout(), small_layout(seed=4)
    assert common_layout([one, same], what="x") == one
    assert common_layout([], what="x") is DEXTOUCH_V1
    assert one.fingerprint != other.fingerprint
    with pytest.raises(InvalidInputError, match=r"x: got tactile layouts 'small' \(138 taxels, "):
        common_layout([one, other], what="x")


def devices(tmp_path, kind, **settings):
    given = {"kind": kind, "side": "left", "port": "/dev/none", **settings}
    return [device_kind(kind).settings.model_validate(given)]


def test_the_settings_of_a_glove_name_its_layout(tmp_path):
    path, clock = written(tmp_path), StationClock()
    (driver,) = build_drivers(devices(tmp_path, "justfloat_glove", layout=path), clock)
    (descriptor,) = driver.descriptors
    assert (descriptor.shape, descriptor.nominal_rate_hz) == ((150,), 50)
    assert driver.decoder.cells.full_scale == 4.0
    assert needed_matrices([descriptor]) == ["tactile_left_tare_counts"]
    with pytest.raises(ValidationError, match="got no num_values, full_scale, rate_hz"):
        devices(tmp_path, "justfloat_glove")
    with pytest.raises(InvalidInputError, match="num_raw_cells 150, expected 768"):
        build_drivers(devices(tmp_path, "wuji_glove", layout=path), clock)
    path = written(tmp_path, unit="counts", full_scale=70_000)
    with pytest.raises(InvalidInputError, match="full_scale 70000, expected at most 65535"):
        build_drivers(devices(tmp_path, "tactile_glove", layout=path), clock)
    path = written(tmp_path, unit="counts", full_scale=4095)
    (driver,) = build_drivers(devices(tmp_path, "tactile_glove", layout=path), clock)
    assert needed_matrices(driver.descriptors) == [
        "tactile_left_tare_counts",
        "tactile_left_gain_counts_per_kpa",
    ]


def test_a_wuji_glove_takes_only_layouts_of_what_it_sends():
    plain = small_layout(unit="full_scale", full_scale=1.0).model_dump() | {"num_raw_cells": 768}
    layout = TactileLayout.model_validate(plain | {"kpa_per_unit": 50.0})
    decoder = WujiGloveDecoder("left", layout=layout)
    assert decoder.descriptors[0].unit == "full_scale"
    # Half of full scale is 25 kPa.
    record = {"tactile_left_tare_counts": ((0.0,) * 768,)}
    glove = TactileCalibration.from_record(record, "left", layout=layout)
    np.testing.assert_allclose(glove.to_kpa(np.full((1, 768), 0.5)), 25.0)
    for wrong in ({"unit": "kPa", "kpa_per_unit": None}, {"full_scale": 50.0}):
        other = TactileLayout.model_validate(layout.model_dump() | wrong)
        with pytest.raises(InvalidInputError, match=r"expected 'full_scale' and 1, .*kpa_per_unit"):
            WujiGloveDecoder("left", layout=other)


def test_taxels_in_kpa_are_in_order_and_need_no_record():
    descriptor = played(small_layout(), np.zeros((1, 138))).descriptor
    assert needed_matrices([descriptor]) == []
    np.testing.assert_array_equal(mapped_cells(descriptor, {}), range(138))
    # A tare of raw cells, such as that of the glove itself, says nothing of them.
    assert glove_record(descriptor, {"tactile_left_tare_counts": ((0.0,) * 150,)}) is None


@pytest.mark.parametrize("unit", ["N", "mbar"])
def test_a_glove_of_floats_is_calibrated_in_its_own_unit(unit):
    """Tare and gain come back in the unit of the readings, from noisy ones of known pressures."""
    full_scale = {"N": 4.0, "mbar": 500.0}[unit]
    layout, rng = small_layout(unit=unit, full_scale=full_scale), np.random.default_rng(5)
    step = full_scale / 65535
    tare = rng.uniform(0.01, 0.02, 150) * full_scale
    gain = rng.uniform(0.5, 1.0, 150) * full_scale / 50

    def take(kpa):
        return (tare + gain * kpa + rng.normal(0, 3 * step, (120, 150))) / step

    rest = measure_tare(take(0.0), side="left", layout=layout)
    everywhere = np.ones(138, dtype=bool)
    presses = [TaxelPress(kpa, 0.01 * kpa, take(kpa), everywhere) for kpa in (10.0, 20.0, 40.0)]
    found = calibrate_glove(rest, presses).matrices()
    wired = list(layout.raw_cells.left)
    np.testing.assert_allclose(found["tactile_left_tare_counts"][0], tare, atol=2 * step)
    measured = found["tactile_left_gain_counts_per_kpa"][0][wired]
    np.testing.assert_allclose(measured, gain[wired], rtol=0.01)
    record = {name: matrix.tolist() for name, matrix in found.items()}
    glove = TactileCalibration.from_record(record, "left", layout=layout)
    readings = np.tile(tare + gain * 25, (2, 1))
    np.testing.assert_allclose(glove.to_kpa(readings), 25, rtol=0.02)


def test_health_finds_a_dead_cell_by_its_neighbours_on_the_pad():
    layout = small_layout()
    decoder = JustFloatGloveDecoder(
        "left", num_values=150, full_scale=4.0, rate_hz=50.0, layout=layout
    )
    check = cell_judge(decoder, {})
    # Row 3, column 4 of the palm, whose neighbours in the sample are other taxels.
    dead, rng = 75 + 3 * 9 + 4, np.random.default_rng(6)
    for second in range(3):
        t_s = second + np.arange(1, 51) / 50
        wave = 1.0 + np.sin(2 * np.pi * t_s[:, None] + 0.1 * np.arange(138))
        taxels = wave + rng.normal(0.01, 0.001, wave.shape)
        taxels[:, dead] = 0.0
        values = layout.expand(taxels, side="left").astype(np.float32)
        found = judged(check, block(t_s, values), (second + 1) * SECOND_NS)
    assert found.taxels == {"dead": (dead,)}


def test_a_changed_copy_is_another_layout():
    layout = small_layout()
    assert layout == small_layout()
    renamed = layout.model_copy(update={"name": "other"})
    assert (renamed.name, renamed == layout) == ("other", False)
    assert renamed.fingerprint != layout.fingerprint
    with pytest.raises(ValidationError, match="num_raw_cells"):
        layout.model_copy(update={"num_raw_cells": 1})
