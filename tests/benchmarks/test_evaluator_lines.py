"""Lines of the stage `evaluator` against figures that were calculated by hand."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.evaluator.benchmark import interval_table, row_table
from benchmarks.evaluator.drawn import Rolled
from benchmarks.evaluator.lines import TaskFigures
from benchmarks.evaluator.playing import (
    ImaginedRollout,
    StillRollout,
    TrueRollout,
    chunks_that_move,
    sharpness_of_chunks,
    still_figures,
    wrong_action_figures,
)
from benchmarks.evaluator.work import refuse_unequal_tasks
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import HandTrajectory
from dextouch.schemas import RolloutUncertainty

SCRIPTS = ("script 0 mm", "script 9 mm")
COPY = "chained contact F1 less copy, worst chunk where anything moves"
CONTEXT = "chained contact F1 over F1 with true context, worst chunk where anything moves"


def _verdict(told: float) -> dict:
    decision = "success" if told >= 0.7 else "failure" if told <= 0.3 else "cannot tell"
    return {"probability": told, "likely_success": told >= 0.5, "decision": decision}


def _rolled(policy: str, seed: int, *, real: bool, told: float) -> Rolled:
    rows = {
        "true verdict": _verdict(float(real)),
        "imagined verdict": _verdict(told),
        "imagined": {
            "contact": [[2.0, 4.0, 6.0]] * 5,
            "contact_of_copy": [[3.0, 6.0, 6.0]] * 4 + [[6.0, 6.0, 6.0]],
            "psnr": [[25.0 + chunk, 20.0] for chunk in range(5)],
            "psnr_of_objects": [[18.0, 19.0], *[[22.0, 19.0]] * 4],
        },
    }
    if policy in SCRIPTS:
        # Where nothing moves, in the last chunk, a copy may be as good as it likes.
        rows |= {
            "true context": {
                "contact": [[4.0, 8.0, 8.0]] * 5,
                "moves": [True] * 4 + [False],
            },
            "sharpness": {"sharpness": [[6.0, 10.0], *[[7.25, 10.0]] * 4]},
            "verdict of the last image": _verdict(told),
        }
    return Rolled(policy, seed, real, rows)


@pytest.fixture
def rolled():
    return [
        _rolled("script 0 mm", 1, real=True, told=0.9),
        _rolled("script 0 mm", 2, real=True, told=0.4),
        _rolled("script 9 mm", 1, real=False, told=0.4),
        _rolled("script 9 mm", 2, real=False, told=0.1),
        _rolled("hold", 1, real=False, told=0.8),
        _rolled("hold", 2, real=False, told=0.2),
    ]


def test_lines_by_hand(rolled):
    figures = TaskFigures("a", [rolled], SCRIPTS)
    lines = {line.what: line for line in figures.lines()}
    # Wins 0.9 and 0.4 against losses 0.4 and 0.1: three pairs right, one tied.
    area = lines["imagined against real, each rollout, AUC"]
    assert area.value == pytest.approx(3.5 / 4)
    assert (area.sense, area.bound) == ("at least", 0.93)
    balanced = lines["imagined against real, each rollout, balanced accuracy"]
    assert balanced.value == pytest.approx(0.75)
    assert lines["judge of the last imagined image alone, AUC"].value == pytest.approx(3.5 / 4)
    assert lines["judge on true endings, AUC"].value == 1.0
    # It decides two of the scripts' four endings, and is right.
    decided = lines["wrong among the decided imagined endings"]
    assert (decided.value, decided.num, decided.bound) == (0.0, 2, 0.05)
    # Two scripts are no correlation. All three: real 1, 0, 0 and imagined 0.5, 0, 0.5.
    two = lines["policies (scripts), Pearson"]
    assert (two.value, two.interval, two.num) == (None, None, 2)
    assert two.text(two.value) == "undefined (2 policies)"
    assert lines["policies (all), Pearson"].value == pytest.approx(0.5)
    # Real 1, 0, 0 and imagined 0.5, 0, 0.5: the first is not above the last in imagination.
    worst = lines["policies (all), MMRV with ties"]
    assert worst.value == pytest.approx((1 + 0 + 0) / 3)
    assert worst.requirement().is_met is False
    assert lines["imagined success of hold"].value == 0.5
    assert lines["imagined success of retreat"].value is None
    # F1 is 0.4; that of the copy 0.5 where things move, that with true context 0.5.
    assert lines[COPY].value == pytest.approx(0.4 - 0.5)
    assert lines[CONTEXT].value == pytest.approx(0.4 / 0.5)
    assert lines["chained image, worst chunk"].value == 25.0
    around = "chained image less warped start where objects are or were, worst of chunks 2 to 5"
    assert lines[around].value == 3.0
    assert lines["sharpness of chained images as a share of the truth"].value == pytest.approx(0.7)
    assert lines["still hands over 1000 steps, greatest pressure"].value is None
    shown = interval_table(list(lines.values()))
    assert {"pass", "FAIL"} < {row[5] for row in shown.rows}
    assert "undefined (2 policies)" in {row[1] for row in shown.rows}
    assert "training seeds" not in shown.columns
    assert row_table("Rates", figures.policy_rows()).columns[:3] == ("task", "policy", "starts")
    table = {row[0]: row[1] for row in shown.rows}
    assert table["a: policies (scripts), Pearson"] == "undefined (2 policies)"


def test_several_training_seeds_give_their_mean_and_the_worst(rolled):
    better = [
        replace(one, rows={**one.rows, "imagined verdict": _verdict(float(one.success))})
        for one in rolled
    ]
    figures = TaskFigures("a", [better, rolled], SCRIPTS)
    lines = {line.what: line for line in figures.lines()}
    what = "imagined against real, each rollout, AUC"
    assert lines[what].by_seed == (1.0, 0.875)
    assert lines[what].value == pytest.approx((1 + 0.875) / 2)
    worst = lines[f"{what}, worst training seed"]
    assert (worst.value, worst.bound) == (0.875, 0.87)
    assert worst.requirement().is_met is True
    row = figures.policy_rows()[0]
    assert (row["imagined"], row["imagined_1"], row["imagined_2"]) == (0.75, 1.0, 0.5)
    assert {row["training_seed"] for row in figures.chunk_rows()} == {1, 2}
    table = interval_table(list(lines.values()))
    assert table.columns[-1] == "training seeds"
    assert table.rows[4][-1] == "1.000, 0.875"


def test_wrong_actions_and_still_hands_by_hand(rolled):
    wrong = {"touch_error": [2.0, 5.0], "psnr": [[26.0, 25.0], [28.0, 23.0]]}
    still = {"greatest_kpa": 1.5, "psnr": [[29.0, 30.0], [31.0, 31.0]]}
    worse = {"greatest_kpa": 2.5, "psnr": [[28.0, 30.0], [30.0, 31.0]]}
    for index, row in ((4, still), (5, worse)):
        more = {"wrong actions": wrong, "held still": row}
        rolled[index] = replace(rolled[index], rows=rolled[index].rows | more)
    lines = {line.what: line for line in TaskFigures("a", [rolled], SCRIPTS).lines()}
    touch = lines["touch error with another episode's actions over that with their own"]
    assert touch.value == 2.5
    image = lines["chained image with their own actions less that with another episode's"]
    assert image.value == 3.0
    # The worse of two starts: 2.5 kPa, and on average 1.5 dB below the copy.
    pressure = lines["still hands over 1000 steps, greatest pressure"]
    assert (pressure.value, pressure.interval, pressure.unit) == (2.5, None, "kPa")
    assert lines["the same, image less copy"].value == -1.5


def _images(*levels: int) -> np.ndarray:
    return np.stack([np.full((8, 8, 3), level, np.uint8) for level in levels])


def _true_and_imagined(touch_kpa: float, level: int) -> tuple[TrueRollout, ImaginedRollout]:
    touch, images = np.zeros((81, 2, 320), np.float32), _images(*[level] * 5)
    poses = np.zeros((6, 1, 7))
    truth = _images(*[100] * 5)
    real = TrueRollout(
        success=True,
        actions=np.zeros((80, 67)),
        tactile_kpa=touch,
        images_of_chunks=truth,
        last_images=truth[:3],
        object_poses=poses,
    )
    imagined = ImaginedRollout(
        touch + np.float32(touch_kpa), images, images[:3], None, RolloutUncertainty()
    )
    return real, imagined


def test_errors_of_wrong_actions_by_hand():
    real, own = _true_and_imagined(1.0, 101)
    _, wrong = _true_and_imagined(3.0, 110)
    figures = wrong_action_figures(real, own, wrong)
    assert figures["touch_error"] == [1.0, 9.0]
    # 20 log10 of 255 / 1 and of 255 / 10.
    np.testing.assert_allclose(figures["psnr"], [[48.1308, 28.1308]] * 5, atol=1e-4)


def test_sharpness_by_hand():
    real, imagined = _true_and_imagined(0.0, 0)
    real.images_of_chunks[:, 4, 4] = 136
    # One point of 36 above its neighbours: |−4·36| + 4·|36| over the 6 × 6 inner pixels.
    assert sharpness_of_chunks(real, imagined)[0] == [0.0, pytest.approx(8 * 36 / 36)]


def test_still_figures_by_hand():
    imagined = StillRollout(0.5, _images(101, 110))
    figures = still_figures(imagined, _images(100, 100), _images(100)[0])
    assert figures["greatest_kpa"] == 0.5
    np.testing.assert_allclose(figures["psnr"], [[48.1308, 100], [28.1308, 100]], atol=1e-4)


def test_a_chunk_moves_where_a_finger_or_an_object_does():
    still = np.tile(np.eye(4), (80, 1, 1))
    fingers = np.zeros((80, 20))
    fingers[20:, 3] = 0.1
    commands = HandTrajectory(still, still, fingers, np.zeros((80, 20)), still)
    poses = np.zeros((6, 1, 7))
    poses[..., 3] = 1.0
    poses[4:, 0, 2] = 0.01
    # Fingers at step 21, in the second chunk; an object between the ends of the third and fourth.
    assert chunks_that_move(commands, poses).tolist() == [False, True, False, True, False]
    turned = poses.copy()
    turned[5, 0, 3:] = [np.cos(0.02), 0, 0, np.sin(0.02)]
    assert chunks_that_move(commands, turned)[4]


def test_rivals_by_hand(rolled):
    # The direct judge calls the start's second level right, and everything unlike it a success.
    told = {"script 0 mm": (0.9, 0.6), "script 9 mm": (0.7, 0.1), "hold": (0.9, 0.9)}
    judged = [
        replace(
            one,
            rows=one.rows
            | {
                "direct verdict": _verdict(told[one.policy][one.seed - 1]),
                "verdict without touch": _verdict(0.5),
                "verdict of a world without touch": _verdict(float(not one.success)),
            },
        )
        for one in rolled
    ]
    figures = TaskFigures("a", [judged, judged], SCRIPTS)
    lines = {line.what: line for line in figures.lines()}
    # 0.9 and 0.6 against 0.7 and 0.1: three pairs of four, where imagination has 3.5.
    assert lines["AUC of imagined endings less the direct judge's, scripts"].value == 0.125
    assert lines["AUC of imagined endings less those with touch at zero, scripts"].value == 0.375
    without = lines["AUC of imagined endings less those of a world trained without touch, scripts"]
    assert without.value == 0.875
    # Nothing else than scripts succeeded: there is no area.
    assert lines["AUC of imagined endings less the direct judge's, other policies"].value is None
    rows = {(row["judge"], row["policies"]): row for row in figures.rival_rows()}
    direct = rows["direct judge", "scripts"]
    assert (direct["auc"], direct["called_success"], direct["succeeded"]) == (0.75, 0.75, 0.5)
    held = rows["direct judge", "other policies"]
    assert (held["auc"], held["called_success"], held["succeeded"]) == (None, 1.0, 0.0)
    assert rows["imagined ending", "other policies"]["called_success"] == 0.5


def test_without_direct_judge_there_is_no_line_of_it(rolled):
    figures = TaskFigures("a", [rolled], SCRIPTS)
    assert not [line for line in figures.lines() if "direct" in line.what]
    assert {row["judge"] for row in figures.rival_rows()} == {"imagined ending"}


def test_rivals_of_different_tasks_are_refused():
    refuse_unequal_tasks("--direct", [])
    refuse_unequal_tasks("--direct", [("a", "b"), ("b", "a")])
    with pytest.raises(InvalidInputError, match="--direct"):
        refuse_unequal_tasks("--direct", [("a", "b"), ("a",)])
