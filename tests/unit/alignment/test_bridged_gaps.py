"""Short gaps stay in the episode, interpolated and marked; nothing learns from what is marked."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeGrid, EpisodeStore
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization.resampling import bridged_run, longest_run
from services.world_model.training.joint_dataset import StoredEpisode, window_starts
from tests.unit.alignment import recordings

SECONDS = 20.0
STEP_S = 1 / 15
SPEED_M_S = 0.3


def moving(name, values, arrived_s):
    """Everything moves at a constant speed: whatever is interpolated is right."""
    if values.shape[1] == 7:
        values = values.copy()
        values[:, 0] = SPEED_M_S * arrived_s
    return values


def episode_of(folder, lost, **options):
    """The aligned episode of a robot that loses these (stream, first, last) samples at 100 Hz."""
    store = EpisodeStore(folder)

    def edit(name, values):
        arrived = np.ones(round(SECONDS * 100), dtype=bool)
        for stream, first, last in lost:
            arrived[first:last] &= stream != name
        return moving(name, values, np.flatnonzero(arrived) / 100)

    recordings.write_recording(store, "take", seconds=SECONDS, lost=lost, edit=edit)
    report = align_recording(store, "take", AlignmentOptions(**options))
    return report, EpisodeGrid(store.open(report.episode_id))


def in_gaps(times_s, lost):
    """Steps between the last sample before a gap and the first one after it."""
    return np.any(
        [(times_s > first / 100 - 0.01) & (times_s < last / 100) for _, first, last in lost], axis=0
    )


def test_a_gap_of_60_ms_every_two_seconds_costs_a_step_each(tmp_path):
    lost = [("wrist_left", 200 * k, 200 * k + 6) for k in range(1, 10)]
    report, grid = episode_of(tmp_path, lost)
    assert report.quality["num_steps_refused"] <= 1
    measured = ~grid.interpolated
    assert measured.mean() >= 0.96
    assert measured.sum() >= 0.9 * SECONDS / STEP_S
    # As the ledger has it.
    times_s = grid.t_ref_ns / 1e9 + report.quality["origin_after_start_ns"] / 1e9
    np.testing.assert_array_equal(grid.interpolated, in_gaps(times_s, lost))
    assert not [part for part in report.refused_parts if part.reason == "gap"]
    # Without bridges the longest run alone is left.
    report, grid = episode_of(tmp_path / "split", lost, max_bridged_ms=0)
    assert len(grid) < 2.2 / STEP_S
    assert not grid.interpolated.any()


@pytest.mark.parametrize("stream", ["head", "wrist_right", "joints_measured"])
def test_what_is_bridged_is_a_straight_line_and_marked_by_its_stream(tmp_path, stream):
    lost = [(stream, 500, 520), (stream, 900, 911)]
    report, grid = episode_of(tmp_path, lost)
    assert set(grid.about.calibration) & {f"interpolated_{stream}_s"}
    assert report.quality["num_steps_interpolated"] == grid.interpolated.sum() > 3
    times_s = grid.t_ref_ns / 1e9
    # Wrists move with the anchor's axes, which the world's are.
    moved_m = grid.measured[:, 0] - grid.measured[0, 0]
    np.testing.assert_allclose(moved_m, SPEED_M_S * times_s, atol=1e-6)


def test_longer_gaps_end_the_episode(tmp_path):
    report, grid = episode_of(tmp_path, [("head", 800, 850)])
    assert not grid.interpolated.any()
    assert len(grid) == pytest.approx(11.5 / STEP_S, abs=2)
    assert {part.reason for part in report.refused_parts} >= {"gap", "shorter"}


@pytest.mark.parametrize(
    ("valid", "max_steps", "expected"),
    [
        ("1111111101111", 1, (0, 13)),
        ("1111111100111", 1, (0, 8)),
        ("0111111110111110", 1, (1, 15)),
        ("1010101010", 1, (0, 1)),
        ("11110000111111", 4, (8, 14)),
        ("000", 2, (0, 0)),
    ],
)
def test_runs_are_joined_while_most_of_their_steps_are_measured(valid, max_steps, expected):
    mask = np.array([letter == "1" for letter in valid])
    assert bridged_run(mask, max_steps=max_steps) == expected
    assert bridged_run(mask, max_steps=0) == longest_run(mask)


def test_windows_keep_clear_of_interpolated_steps(tmp_path):
    lost = [("wrist_left", 200 * k, 200 * k + 6) for k in range(1, 10)]
    _, grid = episode_of(tmp_path, lost)
    stored = StoredEpisode(
        url="", episode_id="e", task="t", scene="s", num_steps=len(grid), action_kinds=(),
        content_sha256="", print_sha256="", model_rate_hz=15.0, interpolated=grid.interpolated,
    )  # fmt: skip
    starts = window_starts(stored, 17)
    assert len(starts) > 90
    for start in range(len(grid) - 16):
        is_clear = not grid.interpolated[start : start + 17].any()
        assert (start in starts) == is_clear == grid.is_measured(start, start + 17)
