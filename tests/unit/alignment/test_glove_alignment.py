"""Gloves and cameras in episodes: refused taxels, other makers' cells, lenses that must fit."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.schemas import RecordingAttributes, matrix_rows
from dextouch.streams import ClockCapabilities, SampleBatch, StreamDescriptor
from dextouch.tactile.layout import DEXTOUCH_V1, expand_taxels
from services.acquisition.devices.justfloat_glove import JustFloatGloveDecoder
from services.acquisition.devices.wuji_glove import WujiGloveDecoder
from services.acquisition.mocks.gloves import (
    COUNTS_PER_KPA,
    FULL_SCALE_KPA,
    JustFloatGloveSource,
    WujiGloveSource,
    grid_of,
)
from services.acquisition.mocks.replay import ReplayStream
from services.alignment.command_line import main
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions

K_HEAD = ((10.0, 0.0, 8.0), (0.0, 10.0, 4.0), (0.0, 0.0, 1.0))
POSE = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])
START_NS = 10**12
NUM_SAMPLES = 120
RNG = np.random.default_rng(0)
# Every taxel moves, and none rests at zero.
TRUE_KPA = (10 + 8 * np.sin(np.arange(NUM_SAMPLES)[:, None] / 9 + RNG.uniform(0, 6, 320))).astype(
    np.float32
)
TARE, GAIN = RNG.uniform(110, 130, 360), RNG.uniform(38, 42, 360)


def own_glove():
    """Stream, samples and calibration of a glove of ours on the left hand."""
    counts = np.rint(TARE + GAIN * expand_taxels(TRUE_KPA.astype(float), side="left"))
    t_ns = np.arange(NUM_SAMPLES, dtype=np.int64) * 16_666_667
    stream = glove_descriptor((360,), "uint16", "counts")
    calibration = {
        "tactile_left_tare_counts": matrix_rows(TARE[None]),
        "tactile_left_gain_counts_per_kpa": matrix_rows(GAIN[None]),
    }
    batch = SampleBatch(
        t_ns + START_NS, t_ns, np.arange(NUM_SAMPLES, dtype=np.int64), counts.astype(np.uint16)
    )
    return stream, batch, calibration


def glove_descriptor(shape, dtype, unit, rate_hz=60.0):
    return StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=shape,
        dtype=dtype,
        unit=unit,
        nominal_rate_hz=rate_hz,
        side="left",
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


def mapped(cells, num_cells, tare, gain):
    """Calibration of another maker's glove."""
    return {
        "tactile_left_cells": matrix_rows(np.asarray(cells, dtype=float)[None]),
        "tactile_left_tare_counts": matrix_rows(np.full((1, num_cells), tare)),
        "tactile_left_gain_counts_per_kpa": matrix_rows(np.full((1, num_cells), gain)),
    }


def vendor_glove(family):
    """The same of another maker's glove: bytes of its mock through its decoder."""
    truth = glove_descriptor((320,), "float32", "kPa")
    period_ns = 8_333_333 if family == "wuji" else 16_666_667
    t_ns = np.arange(NUM_SAMPLES, dtype=np.int64) * period_ns
    replay = ReplayStream(truth, t_ns, TRUE_KPA)
    if family == "wuji":
        source, decoder = WujiGloveSource(replay, side="left"), WujiGloveDecoder("left")
        grid = grid_of(np.arange(320, dtype=np.float32)[None]).ravel()
        cells = np.argsort(np.where(np.isnan(grid), np.inf, grid))[:320]
        calibration = mapped(cells, 768, 0.0, 1 / FULL_SCALE_KPA)
    else:
        source = JustFloatGloveSource(replay)
        decoder = JustFloatGloveDecoder("left", num_values=401, full_scale=4095.0, rate_hz=60.0)
        calibration = mapped(np.arange(320), 401, 0.0, COUNTS_PER_KPA)
    samples = []
    for index, t in enumerate(t_ns.tolist()):
        samples += decoder.feed(b"".join(source.units(index, index, t)), t + START_NS)
    return decoder.descriptors[0], SampleBatch.from_samples(samples), calibration


def align(folder, stream, batch, calibration):
    """The report and the episode of a robot's take with one glove."""
    store = EpisodeStore(folder)
    attributes = RecordingAttributes(
        recording_id="take",
        task="stand-bottle",
        instruction="",
        domain="robot",
        station="test",
        calibration={"K_head": K_HEAD} | calibration,
    )
    t_host_ns = np.arange(-10, 220, dtype=np.int64) * 10_000_000 + START_NS
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name in ("wrist_left", "wrist_right", "head", "joints_measured"):
            row = POSE if name != "joints_measured" else np.full(40, 0.25)
            is_pose = len(row) == 7
            body = StreamDescriptor(
                name=name,
                kind="pose" if is_pose else "robot_state",
                shape=row.shape,
                dtype="float64",
                unit="pose_m_wxyz" if is_pose else "rad",
                nominal_rate_hz=100,
            )
            writer.add_stream(body)
            values = np.repeat(row[None], len(t_host_ns), axis=0)
            writer.append(name, values=values, t_host_ns=t_host_ns, t_device_ns=t_host_ns)
        writer.add_stream(stream)
        writer.append(
            stream.name,
            values=batch.values,
            t_host_ns=batch.t_host_ns,
            t_device_ns=batch.t_device_ns,
            sequence=batch.sequence,
        )
    report = align_recording(store, "take", AlignmentOptions())
    return report, store.open(report.episode_id)


@pytest.mark.parametrize(("family", "within_kpa"), [("wuji", 1e-4), ("justfloat", 0.5 / 40 + 1e-4)])
def test_another_makers_glove_becomes_kpa(tmp_path, family, within_kpa):
    stream, batch, calibration = vendor_glove(family)
    assert stream.shape != (360,)
    report, episode = align(tmp_path, stream, batch, calibration)
    touch = episode.read("tactile_left")
    assert episode.streams["tactile_left"].unit == "kPa"
    assert touch.values.shape == (len(batch), 320)
    # Without a tail before it the first packet of a justfloat glove is not known.
    true_kpa = TRUE_KPA[NUM_SAMPLES - len(batch) :]
    np.testing.assert_allclose(touch.values, true_kpa, atol=within_kpa)
    assert report.refused_taxels == {}


def test_refused_taxels_are_zero_named_and_counted(tmp_path):
    stream, batch, calibration = own_glove()
    state = np.zeros(360)
    state[DEXTOUCH_V1.raw_indices(side="left")[[4, 90, 300]]] = (1, 1, 6)
    batch.values[:, DEXTOUCH_V1.raw_indices(side="left")[17]] = 4000
    calibration["tactile_left_taxel_state"] = matrix_rows(state[None])
    report, episode = align(tmp_path, stream, batch, calibration)
    named = {"dead": (4, 90), "stuck": (17,), "imprecise": (300,)}
    assert report.refused_taxels == {"tactile_left": named}
    assert report.quality["tactile_left_num_refused_taxels"] == 4
    assert report.quality["tactile_left_num_dead_taxels"] == 2
    assert "tactile_left_num_unproven_taxels" not in report.quality
    pressures = episode.read("tactile_left").values
    (states,) = np.array(episode.attributes.calibration["tactile_left_refused_taxels"])
    measured = states == 0
    assert np.flatnonzero(~measured).tolist() == [4, 17, 90, 300]
    np.testing.assert_allclose(pressures[:, measured], TRUE_KPA[:, measured], atol=0.02)
    assert (pressures[:, ~measured] == 0).all()


@pytest.mark.long
def test_the_line_of_an_alignment_names_refused_taxels(tmp_path, capsys):
    stream, batch, calibration = own_glove()
    state = np.zeros(360)
    state[DEXTOUCH_V1.raw_indices(side="left")[:20]] = 4
    calibration["tactile_left_taxel_state"] = matrix_rows(state[None])
    align(tmp_path, stream, batch, calibration)
    assert main(["run", "take", "--store", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "tactile_left: taxels not measured and zero: unproven 0 1 2" in said
    assert "11 …" in said


def test_samples_with_a_missing_reading_are_left_out(tmp_path):
    stream, batch, calibration = vendor_glove("wuji")
    values = batch.values.copy()
    values[40, int(calibration["tactile_left_cells"][0][3])] = np.nan
    broken = SampleBatch(batch.t_host_ns, batch.t_device_ns, batch.sequence, values)
    report, episode = align(tmp_path, stream, broken, calibration)
    assert episode.num_samples("tactile_left") == len(batch) - 1
    assert report.quality["tactile_left_num_incomplete"] == 1


def test_a_taxel_of_pressures_that_is_never_measured_costs_no_sample(tmp_path):
    _, batch, _ = own_glove()
    values = TRUE_KPA.copy()
    values[:, 40] = np.nan
    values[7, 41] = np.nan
    broken = SampleBatch(batch.t_host_ns, batch.t_device_ns, batch.sequence, values)
    report, episode = align(tmp_path, glove_descriptor((320,), "float32", "kPa"), broken, {})
    assert report.refused_taxels == {"tactile_left": {"absent": (40,)}}
    assert report.quality["tactile_left_num_incomplete"] == 1
    pressures = episode.read("tactile_left").values
    expected = np.delete(np.where(np.arange(320) == 40, 0, TRUE_KPA), 7, axis=0)
    np.testing.assert_array_equal(pressures, expected)


def test_another_makers_glove_without_a_map_is_refused(tmp_path):
    stream, batch, calibration = vendor_glove("wuji")
    del calibration["tactile_left_cells"]
    with pytest.raises(InvalidInputError, match=r"sends 768 numbers.*'tactile_left_cells'"):
        align(tmp_path, stream, batch, calibration)


def test_cameras_keep_their_distortion_and_must_be_of_the_recorded_size(tmp_path):
    camera = StreamDescriptor(
        name="camera_head",
        kind="image",
        shape=(8, 16, 3),
        dtype="uint8",
        unit="rgb8",
        nominal_rate_hz=30,
    )
    t_ns = np.arange(60, dtype=np.int64) * 33_333_333
    images = np.zeros((60, 8, 16, 3), dtype=np.uint8)
    batch = SampleBatch(t_ns + START_NS, t_ns, np.arange(60, dtype=np.int64), images)
    lens = {
        "distortion_head": ((-0.1, 0.02, 0.001, 0.0, 0.0),),
        "K_head_sigma_px": ((1.0, 1.0, 0.5, 0.5),),
        "K_head_calibrated_at_unix_s": ((1.8e9,),),
        "image_size_head_px": ((16.0, 8.0),),
    }
    _, episode = align(tmp_path / "same", camera, batch, lens)
    assert lens.items() <= episode.attributes.calibration.items()
    with pytest.raises(InvalidInputError, match=r"on images of 8 by 16 px, .*holds 16 by 8"):
        align(tmp_path / "other", camera, batch, lens | {"image_size_head_px": ((8.0, 16.0),)})
    with pytest.raises(InvalidInputError, match="distortion_head"):
        align(tmp_path / "wrong", camera, batch, lens | {"distortion_head": ((0.0,),)})
