"""Matching samples with true ones: drops counted, long delays found, rest not guessed at."""

import numpy as np
import pytest

from dextouch.episodes import StreamData
from dextouch.tactile.layout import DEXTOUCH_V1
from services.alignment import recording_error
from services.alignment.recording_error import NEAR_NS, match_samples

PERIOD_NS = 10_000_000


def truth_and_copy(delay_ns, *, moving):
    t_ns = np.arange(300, dtype=np.int64) * PERIOD_NS
    values = np.sin(t_ns[:, None] * 1e-9 * np.array([3.0, 5.0, 7.0])) * moving
    rng = np.random.default_rng(0)
    kept = rng.random(300) > 0.05
    kept[[0, -1]] = True
    noisy = (values + rng.normal(scale=1e-3, size=values.shape))[kept]
    return StreamData(t_ns, values), StreamData(t_ns[kept] + delay_ns, noisy), kept


@pytest.mark.parametrize("delay_ns", [0, 300_000, 7_000_000, 42_000_000, -33_000_000])
def test_constant_delay_of_many_periods_is_found(delay_ns):
    truth, episode, kept = truth_and_copy(delay_ns, moving=1.0)
    match = match_samples(episode, truth, 0, NEAR_NS, period_ns=PERIOD_NS)
    assert match.mean_offset_ns == delay_ns
    assert (match.offset_ns == delay_ns).all()
    assert match.num_dropped == (~kept).sum()


def test_what_rests_is_matched_by_time_alone():
    truth, episode, _ = truth_and_copy(1_000_000, moving=0.0)
    assert (
        match_samples(episode, truth, 0, NEAR_NS, period_ns=PERIOD_NS).mean_offset_ns == 1_000_000
    )


def gloves(left, right):
    """One sample a glove; keys are taxels, values kPa."""
    values = np.zeros((2, 1, 320), dtype=np.float32)
    for side, pressures in enumerate((left, right)):
        for taxel, kpa in pressures.items():
            values[side, 0, taxel] = kpa
    return values


def test_touch_is_compared_over_the_taxels_of_both_gloves():
    mine = gloves({0: 2.0, 1: 5.0, 2: 1.9}, {7: 3.0, 8: 3.0})
    true = gloves({0: 2.0, 1: 1.0, 2: 1.9}, {7: 3.0, 8: 2.0, 9: 2.5})
    # Left: taxel 0 of 0 and 1. Right: 7 and 8 of 7, 8 and 9. Contact begins at 2 kPa.
    errors = recording_error._taxel_errors(zip(mine, true, strict=True), DEXTOUCH_V1)
    assert errors["taxel_iou"] == pytest.approx(3 / 5)
    assert errors["taxel_mae_kpa"] == pytest.approx((4.0 + 1.0 + 2.5) / 640)


def test_without_gloves_or_contact_there_is_no_agreement_to_tell():
    nothing = gloves({}, {3: 1.0})
    assert recording_error._taxel_errors(zip(nothing, nothing, strict=True), DEXTOUCH_V1) == {
        "taxel_iou": None,
        "taxel_mae_kpa": 0.0,
    }
    assert recording_error._taxel_errors([], DEXTOUCH_V1)["taxel_iou"] is None
