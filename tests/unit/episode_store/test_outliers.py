"""Outliers among toy items: robust scores as scipy computes them, planted outliers counted."""

from collections import Counter

import numpy as np
import pytest
from scipy import stats

from services.episode_store.items import (
    FIGURES,
    MAX_SCORE,
    MIN_ITEMS,
    figure_row,
    figures_of,
    outlier_scores,
    outliers_of,
    spread_of,
)
from tests.unit.episode_store.episodes import write_episode, write_recording

# What usual items of a task look like: mean and standard deviation.
USUAL = {
    "duration_s": (12.0, 1.5),
    "coverage": (0.98, 0.006),
    "clock_residual_ms": (0.4, 0.08),
    "largest_gap_s": (0.05, 0.008),
    "tip_error_mm": (8.0, 1.0),
    "peak_speed_m_s": (1.2, 0.15),
}
# Planted, far outside of the above, each in the direction that is bad.
PLANTED = {
    "duration_s": [31.0, 1.0],
    "coverage": [0.6],
    "clock_residual_ms": [6.0],
    "largest_gap_s": [0.8],
    "tip_error_mm": [35.0],
    "peak_speed_m_s": [4.5, 0.05],
}


def find_outliers(items):
    """Findings of each of the items of one group."""
    spread = spread_of(np.array([figure_row(figures) for figures in items]))
    return [outliers_of(figures, spread) for figures in items]


@pytest.mark.parametrize("num_items", [8, 9, 50])
def test_scores_are_those_of_scipy(num_items):
    values = np.random.default_rng(num_items).gamma(2.0, 3.0, num_items)
    items = np.array([figure_row({"duration_s": value}) for value in values])
    expected = 0.6745 * (values - np.median(values)) / stats.median_abs_deviation(values)
    spread = spread_of(items)
    np.testing.assert_allclose((items - spread[0])[:, 0] / spread[1, 0], expected, rtol=1e-12)
    found = outlier_scores(items, spread)[:, 0]
    np.testing.assert_allclose(found, np.where(abs(expected) > MAX_SCORE, abs(expected), 0.0))


def test_scores_of_values_that_hardly_differ():
    items = np.array([figure_row({"duration_s": value}) for value in [5.0] * 9 + [5.2]])
    # The resolution of a duration.
    np.testing.assert_allclose(spread_of(items)[:, 0], [5.0, 0.25])


def usual_items(rng, count):
    return [
        {name: float(rng.normal(mean, sigma)) for name, (mean, sigma) in USUAL.items()}
        for _ in range(count)
    ]


def test_planted_outliers_are_found_and_few_others():
    """20 tasks of 60 usual items and 8 planted ones: all are found, of 7200 figures few are not."""
    rng, found, false = np.random.default_rng(0), 0, 0
    for _ in range(20):
        items = usual_items(rng, 60)
        planted = []
        for name, values in PLANTED.items():
            for value in values:
                planted.append((len(items), name))
                items.append(usual_items(rng, 1)[0] | {name: value})
        findings = {
            (place, one.figure) for place, own in enumerate(find_outliers(items)) for one in own
        }
        found += len(findings & set(planted))
        false += len(findings - set(planted))
    assert found == 20 * 8
    # Of normal values 0.05 % are above 3.5 robust standard deviations, a few more of 60.
    assert false <= 0.002 * 20 * 60 * len(USUAL)


@pytest.mark.parametrize("num_items", [MIN_ITEMS - 1, MIN_ITEMS])
def test_few_items_are_not_compared(num_items):
    items = [{"duration_s": 5.0}] * (num_items - 1) + [{"duration_s": 500.0}]
    findings = find_outliers(items)
    assert [len(own) for own in findings[:-1]] == [0] * (num_items - 1)
    assert len(findings[-1]) == (num_items >= MIN_ITEMS)


def test_better_than_usual_is_no_finding():
    items = [{"clock_residual_ms": 3.0, "coverage": 0.9}] * 10
    items.append({"clock_residual_ms": 0.01, "coverage": 1.0})
    assert Counter(len(own) for own in find_outliers(items)) == {0: 11}


def test_a_finding_says_what_is_usual():
    items = [{"duration_s": 5.0 + 0.1 * k} for k in range(9)] + [{"duration_s": 30.0}]
    (finding,) = find_outliers(items)[-1]
    # Of 5.0 … 5.8 and 30: median 5.45, deviations 0.05, 0.05, 0.15, 0.15, 0.25, 0.25, 0.35, …
    assert (finding.value, finding.median) == (30.0, pytest.approx(5.45))
    assert finding.score == pytest.approx(0.6745 * 24.55 / 0.25)
    assert finding.message == "duration 30 s, usually 5.45 s"


def test_figures_of_an_episode(settings):
    from dextouch.episodes import EpisodeStore

    store = EpisodeStore(settings.store_url)
    quality = {
        "num_steps_refused": 1.0,
        "head_num_gaps": 2.0,
        "camera_head_num_gaps": 3.0,
        "camera_head_largest_gap_s": 0.4,
        "head_largest_gap_s": 0.1,
        "retargeting_left_tip_error_p95_mm": 7.0,
        "retargeting_right_tip_error_p95_mm": 9.0,
        "retargeting_right_tip_error_mm": 90.0,
        "wrist_left_peak_speed_m_s": 1.5,
        "wrist_right_peak_speed_m_s": 0.5,
        "wrist_left_jerk_p95_m_s3": 20.0,
        "wrist_right_jerk_p95_m_s3": 30.0,
        "static_share": 0.25,
    }
    clocks = [
        {"stream": "head", "residual_rms_ms": 0.2, "num_samples": 90, "num_dropped": 10},
        {"stream": "tactile_left", "residual_rms_ms": 0.5, "num_samples": 100},
    ]
    reader = write_episode(store, "a", num_steps=9, quality=quality, clocks=clocks)
    assert figures_of(reader.attributes, num_steps=9, duration_s=0.6) == {
        "duration_s": 0.6,
        "coverage": 0.9,
        "num_gaps": 5.0,
        "largest_gap_s": 0.4,
        "tip_error_mm": 9.0,
        "peak_speed_m_s": 1.5,
        "jerk_p95_m_s3": 30.0,
        "static_share": 0.25,
        "clock_residual_ms": 0.5,
        "lost_share": 0.05,
    }
    recording = write_recording(store, "r")
    assert figures_of(recording.attributes, num_steps=0, duration_s=1.0) == {"duration_s": 1.0}
    assert len({figure.name for figure in FIGURES}) == len(FIGURES)
