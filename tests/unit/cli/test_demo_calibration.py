"""The demo's gloves are calibrated by a take, not by what the mocks know of themselves."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import LATENCY_SIGMA_MS
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.gloves import GloveCalibration
from services.acquisition.mocks.pattern import pattern_streams
from services.alignment.settings import AlignmentOptions
from services.pipelines import demo_takes as recording
from services.pipelines import mock_takes
from tests.unit.bridges.takes import write_episode
from tests.unit.other_gloves import small_layout

pytestmark = pytest.mark.long

SEED = 3


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    streams = pattern_streams(1.0)
    return mock_takes.measure_gloves(streams, tmp_path_factory.mktemp("spool"), seed=SEED)


@pytest.mark.parametrize("side", ["left", "right"])
def test_tare_and_gain_are_close_to_the_gloves_own_but_measured(measured, side):
    (tare,) = np.array(measured[f"tactile_{side}_tare_counts"])
    (gain,) = np.array(measured[f"tactile_{side}_gain_counts_per_kpa"])
    truth = GloveCalibration.seeded(side, SEED)
    wired = slice(0, 320)  # The last two rows of the scan are not connected.
    # Whole counts: half a count at most.
    assert 0 < np.abs(tare - truth.tare_counts).max() <= 0.5
    errors = gain[wired] / truth.gain_counts_per_kpa[wired] - 1
    # The pressures were known to 1 %, and are the same for all taxels.
    assert 0 < abs(errors.mean()) <= 3 * mock_takes.PRESSURE_SIGMA
    assert errors.std() <= 0.002


def test_a_glove_of_another_unit_is_measured_in_it(tmp_path):
    # Of this full scale the smallest step is half a digit.
    layout = small_layout(unit="digits", full_scale=65535 / 2)
    streams = pattern_streams(1.0, layout=layout)
    found = mock_takes.measure_gloves(streams, tmp_path, seed=SEED, clock=VirtualClock())
    truth, wired = GloveCalibration.seeded("left", SEED, layout), list(layout.raw_cells.left)
    (tare,) = np.array(found["tactile_left_tare_counts"])
    assert np.abs(tare - truth.tare_counts)[wired].max() <= 0.5
    (gain,) = np.array(found["tactile_left_gain_counts_per_kpa"])
    np.testing.assert_allclose(gain[wired], truth.gain_counts_per_kpa[wired], rtol=0.03)


@pytest.mark.parametrize("side", ["left", "right"])
def test_path_delays_are_measured_and_not_what_the_script_states(measured, side):
    (((latency_ns,),), ((sigma_ns,),)) = (
        measured[f"tactile_{side}_latency{name}_ns"] for name in ("", "_sigma")
    )
    stated_ns = FaultScript.first_light().of(f"glove_{side}").path_delay_ms * 1e6
    # A real clock: the mock's threads wake late, which belongs to the path, by what the host does.
    assert 0 < abs(latency_ns - stated_ns) < 5e6
    assert 0 < sigma_ns < 5e6


def test_a_take_is_aligned_again_with_the_calibration_that_its_devices_have(measured, tmp_path):
    streams = pattern_streams(3.0)
    plan = mock_takes.TakePlan(
        streams,
        TakePrompt(task="wave", instruction="wave", domain="human"),
        success=True,
        calibration={"K_head": ((75.0, 0.0, 32.0), (0.0, 75.0, 32.0), (0.0, 0.0, 1.0)), **measured},
        recording_id="demo-human",
        seed=SEED,
        unit_seed=SEED,
    )
    take, _ = mock_takes.play_take(plan, tmp_path / "spool", station="demo")
    options = AlignmentOptions(max_gap_ms=200.0)
    episode = recording.align_truly(take, EpisodeStore(tmp_path / "true"), options)
    delays_ms = {clock.stream: clock.latency_ms for clock in episode.attributes.clocks}
    script = FaultScript.first_light()
    assert delays_ms["tactile_left"] == script.of("glove_left").path_delay_ms
    assert delays_ms["head"] == script.of("pose_tracker_head").path_delay_ms
    (played_kpa,) = (s.values for s in streams if s.descriptor.name == "tactile_left")
    gain = GloveCalibration.seeded("left", SEED).gain_counts_per_kpa.min()
    read_kpa = episode.read("tactile_left").values[::20].astype(float)
    errors_kpa = [np.abs(played_kpa - one).max(axis=1).min() for one in read_kpa]
    # The glove rounds to whole counts; nothing else is wrong.
    assert max(errors_kpa) <= 0.501 / gain


def test_without_gloves_nothing_is_measured(tmp_path):
    streams = [s for s in pattern_streams(1.0) if s.descriptor.kind != "tactile"]
    assert mock_takes.measure_gloves(streams, tmp_path, seed=SEED) == {}


def test_the_take_carries_what_was_measured_and_not_the_gloves_own(tmp_path, monkeypatch):
    truth = write_episode(EpisodeStore(tmp_path / "truth"), num_steps=3)
    streams = [s for s in pattern_streams(1.0) if s.descriptor.kind == "tactile"]
    monkeypatch.setattr(recording, "replay_streams", lambda _: streams)
    take, _ = recording.record_take(truth, tmp_path / "spool", seed=SEED)
    kept = SpoolReader(take.spool_path).attributes.calibration
    for side in ("left", "right"):
        assert kept[f"tactile_{side}_latency_sigma_ns"] != ((LATENCY_SIGMA_MS * 1e6,),)
        own = GloveCalibration.seeded(side, SEED)
        (tare,) = np.array(kept[f"tactile_{side}_tare_counts"])
        (gain,) = np.array(kept[f"tactile_{side}_gain_counts_per_kpa"])
        assert (tare == np.rint(own.tare_counts)).all()
        assert not np.isclose(gain, own.gain_counts_per_kpa, rtol=1e-6).any()
