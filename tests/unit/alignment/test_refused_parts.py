"""What is not in the episode is named with its reason, in the episode and in the report."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization.resampling import (
    RefusedPart,
    longest_run,
    refused_matrices,
    refused_parts,
    refused_stretches,
    runs_of,
)
from tests.unit.alignment.recordings import write_recording

SECOND_NS = 10**9


def test_stretches_by_stream_and_reason():
    valid = {
        "head": np.array([1, 1, 0, 0, 1, 1, 1, 1], dtype=bool),
        "wrist": np.array([1, 1, 1, 0, 1, 1, 1, 0], dtype=bool),
    }
    t_ns = np.arange(8, dtype=np.int64) * SECOND_NS + 100 * SECOND_NS
    parts = refused_stretches(t_ns, valid, (4, 7), 90 * SECOND_NS)
    found = {(part.start_s, part.stop_s, part.reason, part.stream) for part in parts}
    assert found == {
        (12.0, 14.0, "gap", "head"),
        (13.0, 14.0, "gap", "wrist"),
        (17.0, 18.0, "gap", "wrist"),
        (10.0, 12.0, "shorter", None),
    }
    assert set(refused_parts(refused_matrices(parts))) == set(parts)


def test_names_of_other_matrices_are_left_alone():
    calibration = {
        "K_head": ((1.0, 0.0, 0.0),),
        "tactile_left_refused_taxels": ((0.0,) * 320,),
        "refused_late_start_wrist_left_s": ((0.5, 1.5),),
        "refused_shorter_s": ((2.0, 3.0),),
    }
    assert refused_parts(calibration) == (
        RefusedPart(start_s=0.5, stop_s=1.5, reason="late_start", stream="wrist_left"),
        RefusedPart(start_s=2.0, stop_s=3.0, reason="shorter"),
    )


@pytest.mark.parametrize("text", ["", "1", "0", "0110", "1101110", "10101"])
def test_runs(text):
    valid = np.array([letter == "1" for letter in text], dtype=bool)
    runs = runs_of(valid)
    rebuilt = np.zeros(len(valid), dtype=bool)
    for start, stop in runs:
        assert stop > start
        assert not rebuilt[max(start - 1, 0) : stop].any()
        rebuilt[start:stop] = True
    np.testing.assert_array_equal(rebuilt, valid)
    longest = longest_run(valid)
    assert longest[1] - longest[0] == max((b - a for a, b in runs), default=0)


def test_report_names_what_a_recording_lost(tmp_path):
    store = EpisodeStore(tmp_path)
    lost = (("wrist_left", 300, 400), ("head", 0, 50), ("wrist_right", 950, 1000))
    write_recording(store, "take", seconds=10.0, lost=lost)
    report = align_recording(store, "take", AlignmentOptions())
    assert report == align_recording(store, "take", AlignmentOptions()).model_copy(
        update={"created": True}
    )
    found = {(part.reason, part.stream): part for part in report.refused_parts}
    assert set(found) == {
        ("late_start", "head"),
        ("early_end", "wrist_right"),
        ("gap", "wrist_left"),
        ("shorter", None),
    }
    step_s = 1 / 15
    late, gap = found["late_start", "head"], found["gap", "wrist_left"]
    assert (late.start_s, late.stop_s) == pytest.approx((0.0, 0.5), abs=1e-3)
    assert (gap.start_s, gap.stop_s) == pytest.approx((3.0, 4.0), abs=2 * step_s)
    early = found["early_end", "wrist_right"]
    assert (early.start_s, early.stop_s) == pytest.approx((9.5, 10.0), abs=0.02)
    # Together with the episode they cover the recording.
    covered_s = sum(part.stop_s - part.start_s for part in report.refused_parts)
    assert covered_s + report.duration_s == pytest.approx(10.0, abs=3 * step_s)
    assert report.duration_s == pytest.approx(5.5, abs=2 * step_s)
