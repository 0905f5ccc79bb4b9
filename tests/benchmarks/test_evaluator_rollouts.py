"""Stage `evaluator`: what is kept is not computed again, and its figures by hand."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.evaluator import work
from benchmarks.evaluator.benchmark import figures_of_tasks
from benchmarks.evaluator.keeping import KeptRows, array_path, read_arrays, write_arrays
from benchmarks.evaluator.lines import f1
from benchmarks.evaluator.plan import (
    IDLE,
    ClonedPolicy,
    OutsidePolicy,
    StudyPlan,
    Trained,
    trained_seeds,
)
from benchmarks.evaluator.playing import (
    contact_counts,
    object_region,
    play_in_twin,
    psnr_within,
    start_in_twin,
)
from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError, UnknownNameError
from dextouch.geometry import transform
from services.evaluation.policies.colour_servo import ColourServo
from services.evaluation.prediction_scenes import warp_over_table
from services.evaluation.settings import DEFAULT_PROBE
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld
from services.world_model.shipped_checkpoints import PRETRAINED

TINY = PRETRAINED / "tiny.safetensors"

K = np.array([[50.0, 0, 16], [0, 50.0, 16], [0, 0, 1]])
# One metre above the table, looking straight down: x right, y away from world y.
DOWN = np.diag([1.0, -1.0, -1.0])


def _row(seed: int, **more: object) -> dict:
    return {"kind": "real", "twin": "t", "task": "a", "seed": seed, "policy": "p", **more}


def test_rows_are_kept_and_found_again(tmp_path):
    path = tmp_path / "kept" / "rows.jsonl"
    KeptRows(path).add([_row(1, success=True), _row(2, success=False)])
    again = KeptRows(path)
    assert again.get(**_row(1))["success"] is True
    assert again.get(**_row(3)) is None
    assert again.get(**{**_row(1), "twin": "another"}) is None
    again.add([_row(1, success=False)])
    assert KeptRows(path).get(**_row(1))["success"] is True


def test_a_line_that_was_cut_off_is_skipped(tmp_path):
    path = tmp_path / "rows.jsonl"
    KeptRows(path).add([_row(1, success=True)])
    with path.open("a", encoding="utf-8") as file:
        file.write('{"kind": "real", "twin": "t", "ta')
    cut = KeptRows(path)
    assert len(cut) == 1
    cut.add([_row(2, success=True)])
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(KeptRows(path)) == 2
    assert json.loads(lines[-1])["seed"] == 2


def test_arrays_come_back_or_are_refused(tmp_path):
    path = array_path(tmp_path, digests=("0123456789abcdef", "ab"), **_row(1))
    write_arrays(path, {"touch": np.arange(3.0)})
    assert read_arrays(path)["touch"].tolist() == [0, 1, 2]
    path.write_bytes(b"no arrays")
    with pytest.raises(CorruptDataError, match="remove the file"):
        read_arrays(path)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    torch.set_num_threads(1)
    keep = tmp_path_factory.mktemp("kept")
    trained = (Trained(None, DEFAULT_PROBE),)
    return StudyPlan(keep, trained, ("stand_bottle",), (39_077,), (0.0,), num_still_starts=0)


@pytest.mark.slow
def test_a_killed_run_goes_on_without_rolling_out_again(plan, monkeypatch):
    study, path = work.Study(plan), plan.keep / "rollouts.jsonl"
    missing = study.missing(KeptRows(path), "stand_bottle", 39_077)
    assert list(missing) == ["script 0 mm", *IDLE]
    # Killed in the first policy, after its two rollouts and before its verdicts.
    rows = study.rows("stand_bottle", 39_077, {"script 0 mm": missing["script 0 mm"]})
    KeptRows(path).add([next(rows), next(rows)])
    left = study.missing(KeptRows(path), "stand_bottle", 39_077)["script 0 mm"]
    assert left == missing["script 0 mm"][2:]

    def refuse(*_: object) -> None:
        raise AssertionError("rolled out again")

    for name in ("play_in_twin", "play_in_imagination"):
        monkeypatch.setattr(work, name, refuse)
    kept = KeptRows(path)
    kept.add(study.rows("stand_bottle", 39_077, {"script 0 mm": left}))
    assert list(study.missing(KeptRows(path), "stand_bottle", 39_077)) == list(IDLE)
    figures, failed = figures_of_tasks(study, kept)
    assert failed == len(IDLE)
    assert [row["real"] for row in figures[0].policy_rows()] == [1.0]
    chunks = figures[0].chunk_rows()
    assert [row["chunk"] for row in chunks] == [1, 2, 3, 4, 5]
    # The camera's motion over a table is known: the warped start is no wild guess.
    assert all(row["psnr_of_warped_start"] > 15 for row in chunks)
    # The first chunk begins at the true start either way.
    about = study.keys("stand_bottle", 39_077, "script 0 mm")
    imagined, context = (kept.get(**about[kind, 0]) for kind in ("imagined", "true context"))
    assert context["contact"][0] == imagined["contact"][0]
    # The true touch of a chunk is the same, from wherever it is imagined.
    assert [each[2] for each in context["contact"]] == [each[2] for each in imagined["contact"]]
    assert context["moves"][:3] == [True, True, True]


def test_training_seeds_share_what_really_happened(plan):
    study = work.Study(plan)
    study.members = (study.members[0], study.members[0])
    keys = study.keys("stand_bottle", 39_077, "script 0 mm")
    assert {number for _, number in keys} == {0, 1}
    assert keys["real", 0] == keys["real", 1]
    # The same checkpoints twice: every row is wanted once.
    rows = study.missing(KeptRows(plan.keep / "none.jsonl"), "stand_bottle", 39_077)
    assert len(rows["script 0 mm"]) == len(keys) // 2
    assert list(study.about) == ["twin", "world 1", "judge 1", "world 2", "judge 2"]


def test_judges_belong_to_worlds_in_their_order(tmp_path):
    worlds, probes = [tmp_path / "a", tmp_path / "b"], [tmp_path / "p", tmp_path / "q"]
    assert [one.probe for one in trained_seeds(worlds, probes, ())] == probes
    assert [one.probe for one in trained_seeds(worlds, probes[:1], ())] == [probes[0]] * 2
    assert [one.direct for one in trained_seeds(worlds, probes, probes[1:])] == [probes[1]] * 2
    both = trained_seeds(worlds, probes, (), worlds)
    assert [(one.direct, one.untouched) for one in both] == [(None, worlds[0]), (None, worlds[1])]
    with pytest.raises(InvalidInputError, match="3 --without-touch for 2 --world"):
        trained_seeds(worlds, probes, (), [*worlds, *worlds[:1]])
    with pytest.raises(InvalidInputError, match="2 --probe for 1 --world"):
        trained_seeds(worlds[:1], probes, ())
    with pytest.raises(InvalidInputError, match="0 --probe"):
        trained_seeds(worlds, (), ())


def test_a_world_without_touch_is_judged_without_it(plan):
    untouched = replace(plan, trained=(Trained(None, DEFAULT_PROBE, untouched=TINY),))
    study = work.Study(untouched)
    # The package's model of the paper's form knows the bottle and the bowls; any world will do.
    name = ("verdict of a world without touch", 0)
    key = study.keys("stand_bottle", 39_077, "script 0 mm")[name]
    assert key["world without touch"] != study.members[0].about["world"]
    assert "world" not in key
    rows = list(study.rows("stand_bottle", 39_077, {"script 0 mm": (name,)}))
    assert 0 <= rows[0]["probability"] <= 1


def test_starts_of_the_training_are_refused(plan):
    study = work.Study(plan)
    first = work.start_in_twin(study.twin, "stand_bottle", 39_077, "")[0].observation
    digest = work.first_digest(first)
    probe = study.members[0].probe
    probe.metadata = probe.metadata.model_copy(update={"training_starts": (digest,)})
    with pytest.raises(ConflictError, match="trained on by a judge"):
        next(study.rows("stand_bottle", 39_077, {"hold": (("real", 0),)}))


def test_contact_f1_by_hand():
    told, true = np.zeros((2, 2, 320), np.float32), np.zeros((2, 2, 320), np.float32)
    told[0, 0, :4], true[0, 0, 2:8] = 5.0, 5.0
    assert contact_counts(told, true) == [2, 4, 6]
    assert f1(np.array([2.0, 4.0, 6.0])) == pytest.approx(0.4)
    assert f1(np.zeros(3)) == 1.0


def test_a_still_camera_warps_nothing():
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    T = transform(DOWN, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_array_equal(warp_over_table(image, K, T, T), image)


def test_a_camera_that_moves_over_the_table_by_hand():
    # From 1 m above, 40 mm along world x are 50 px/m · 0.04 m = 2 px to the right.
    image = np.random.default_rng(1).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    then = transform(DOWN, np.array([0.0, 0.0, 1.0]))
    now = transform(DOWN, np.array([0.04, 0.0, 1.0]))
    warped = warp_over_table(image, K, then, now)
    np.testing.assert_array_equal(warped[:, :-2], image[:, 2:])


def test_the_region_of_an_object_by_hand():
    # A cube of 80 mm on the axis: its top, 0.96 m away, spans 0.04 / 0.96 · 50 = 2.08 px each way.
    pose = np.array([[0, 0, 0, 1.0, 0, 0, 0]])
    box = np.array([[0, 0, 0, 0.04, 0.04, 0.04]])
    T = transform(DOWN, np.array([0.0, 0.0, 1.0]))
    region = object_region(pose, box, K, T, (32, 32))
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    assert (rows[0], rows[-1]) == (columns[0], columns[-1]) == (12, 19)
    image = np.zeros((32, 32, 3), np.uint8)
    other = image.copy()
    other[~region] = 255
    assert psnr_within(other, image, region) == 100.0


class LooksAtAll(ColourServo):
    """The same policy, to which worlds show every step."""

    uses_images = True


def test_a_policy_that_looks_last_acts_as_if_it_saw_every_step():
    twin = TwinWorld(TwinSettings(cameras=("camera_head",)))
    started, _, start = start_in_twin(twin, "open_drawer", 39_077, "")
    last, everything = (
        play_in_twin(twin, started, policy, start) for policy in (ColourServo(), LooksAtAll())
    )
    for name, array in vars(last).items():
        np.testing.assert_array_equal(array, getattr(everything, name), err_msg=name)


def test_outside_policies_are_known_by_their_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "class Still:\n    tasks = ('juggle',)\n\n    def act(self, observation): ...\n"
    (tmp_path / "still_policy_of_a_test.py").write_text(code)
    found = OutsidePolicy.parse("still=still_policy_of_a_test:Still")
    assert found.key == f"still@{hashlib.sha256(code.encode()).hexdigest()[:8]}"
    with pytest.raises(UnknownNameError, match="Still"):
        OutsidePolicy.parse("still_policy_of_a_test:Moving")
    with pytest.raises(InvalidInputError, match="MODULE:FACTORY"):
        OutsidePolicy.parse("no address")


def test_policies_act_in_their_own_tasks(plan):
    servo = OutsidePolicy.parse("servo=services.evaluation.policies.colour_servo:ColourServo")
    study = work.Study(replace(plan, outside=(servo,)))
    assert servo.key in study.policies("stand_bottle", 39_077)
    assert servo.key not in study.policies("insert_peg", 39_077)
    assert isinstance(study.actor("stand_bottle", 39_077, servo.key), ColourServo)


def test_plans_without_anything_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="0 starts"):
        StudyPlan(tmp_path, (Trained(None, DEFAULT_PROBE),), ("stand_bottle",), ())
    with pytest.raises(InvalidInputError, match="NAME=PATH"):
        ClonedPolicy.parse("no-path")
