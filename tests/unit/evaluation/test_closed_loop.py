"""The closed loop over HTTP: matched starts, disjoint seeds, and scores that tell worlds apart."""

from contextlib import ExitStack

import numpy as np
import pytest

from dextouch.clients import http_link
from dextouch.clients.rollouts import RolloutClient
from dextouch.errors import ConflictError, InvalidInputError, ShapeError, UnknownNameError
from dextouch.schemas import Uncertainty
from dextouch.worlds import WorldServiceSettings, create_world_app
from dextouch.worlds.baseline import CopyFirstWorld
from services.evaluation.closed_loop import EvaluationPlan, RolloutRunner, evaluate, film
from services.evaluation.matched_starts import StudyWorlds, WorldAddress, matched_start
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.open_loop import HoldPolicy
from services.evaluation.rating.rubrics import Rubric
from services.evaluation.success_classifier import SuccessClassifier, Verdict
from tests.unit.evaluation import toy
from tests.unit.other_gloves import small_layout
from tests.unit.worlds.running import served

pytestmark = pytest.mark.long

SEEDS = range(2000, 2003)


class Hesitant(toy.ToyWorld):
    """Doubts its second chunk alone, and estimates success at a quarter after the last one."""

    def step(self, state, actions, **options):
        stepped = super().step(state, actions, **options)
        is_second = state.step == 16
        uncertainty = Uncertainty(
            disagreement=0, distance=0, outside=is_second, reason="slipped" if is_second else None,
            success_probability=0.25 if stepped.observation.last_step == 80 else 1.0,
        )  # fmt: skip
        return toy.replace(
            stepped, observation=toy.replace(stepped.observation, uncertainty=uncertainty)
        )


class Reporting(toy.ToyWorld):
    """Says after each chunk whether the hand was near the target in it, and how far it moved."""

    def step(self, state, actions, **options):
        stepped = super().step(state, actions, **options)
        near = float(stepped.observation.tactile_kpa.max() > 0)
        return toy.replace(stepped, info={"milestone/near": near, "moved_m": 0.1})


class Forgetful(toy.ToyWorld):
    """A judge that never begins the same way twice."""

    def reset(self, start):
        self.count = getattr(self, "count", 0) + 1
        return super().reset(toy.replace(start, seed=start.seed + self.count))


@pytest.fixture(scope="module")
def client():
    judge = toy.ToyWorld("judge", judge=True)
    wide_judge = toy.ToyWorld("wide judge", judge=True, cameras=toy.TWO_CAMERAS)
    worlds = {
        "judge": judge,
        "dream": toy.ToyWorld("dream", judge=False),
        "nightmare": toy.ToyWorld("nightmare", judge=False, drift_m=0.05),
        "hesitant": Hesitant("hesitant", judge=False),
        "choosy": Choosy("choosy", judge=True),
        "reporting": Reporting("reporting", judge=True),
        "forgetful": Forgetful("forgetful", judge=True),
        "copy-first": CopyFirstWorld.beside(judge.description),
        "wide": toy.ToyWorld("wide", judge=False, cameras=toy.TWO_CAMERAS),
        "wide judge": wide_judge,
        "small glove": toy.ToyWorld("small glove", judge=False, layout=small_layout()),
        "wide copy-first": CopyFirstWorld.beside(wide_judge.description),
    }
    with served(create_world_app(worlds, WorldServiceSettings())) as url, RolloutClient(url) as it:
        yield it


@pytest.fixture(scope="module")
def probe(trained_probe):
    return SuccessClassifier(trained_probe)


@pytest.fixture(scope="module")
def policies(trained_policies):
    good = [toy.demonstration(t, s) for t in toy.TASKS for s in SEEDS]
    poor = [toy.demonstration(t, s, noise_m=0.08) for t in toy.TASKS for s in SEEDS]
    return {
        "script": toy.replay(good),
        "clumsy script": toy.replay(poor),
        "cloned": BehaviourCloningPolicy(trained_policies[0]),
        "hold": HoldPolicy(),
    }


def addresses(client, *names):
    return {name: WorldAddress(client, name) for name in names}


@pytest.fixture(scope="module")
def report(client, policies, probe):
    return evaluate(
        real=WorldAddress(client, "judge"),
        imagined=addresses(client, "dream", "nightmare", "copy-first"),
        policies=policies,
        plan=EvaluationPlan(toy.INSTRUCTIONS, SEEDS),
        probe=probe,
    )


def test_the_pair_to_show_is_the_one_that_tells_most(client, policies, probe, report):
    """Of each task one whose outcomes differ, or a success; played as it was, with all images."""
    given = {"imagined": addresses(client, "dream"), "policies": policies, "probe": probe}
    plan = EvaluationPlan(toy.INSTRUCTIONS, SEEDS)
    shown = film(report, real=WorldAddress(client, "judge"), plan=plan, **given)
    known = {(s.world, s.task, s.policy, s.seed): s.success for s in report.scores}
    assert len(shown) == len(toy.TASKS)
    for task, pair in zip(toy.TASKS, shown, strict=True):
        _, policy, rest = pair.title.split(", ", 2)
        seed = int(rest.split()[1].rstrip(":"))
        real, imagined = (known[world, task, policy, seed] for world in ("real", "dream"))
        others = [
            (known["real", task, p, s], known["dream", task, p, s]) for p in policies for s in SEEDS
        ]
        assert real != imagined or (real and all(a == b for a, b in others))
        assert rest.endswith(
            f"{'success' if real else 'failure'} in fact, "
            f"{'success' if imagined else 'failure'} imagined"
        )
        assert pair.true_images.shape == pair.predicted_images.shape == (81, 32, 32, 3)
        assert pair.times_s[-1] == pytest.approx(80 / 15)
        np.testing.assert_array_equal(pair.true_images[0], pair.predicted_images[0])
        assert (pair.true_images[0] != pair.true_images[-1]).any() or policy == "hold"


def test_a_doubt_amid_a_rollout_is_not_forgotten_at_its_end(client, policies, probe):
    found = evaluate(
        real=WorldAddress(client, "judge"),
        imagined=addresses(client, "dream", "hesitant"),
        policies={"script": policies["script"]},
        plan=EvaluationPlan({"reach": toy.INSTRUCTIONS["reach"]}, SEEDS),
        probe=probe,
    )
    by_world = {
        world: [one for one in found.scores if one.world == world]
        for world in ("real", "dream", "hesitant")
    }
    for one in by_world["hesitant"]:
        assert one.cannot_tell == "the world flags its prediction: at step 32, slipped"
        assert one.world_probability == 0.25
    assert {one.cannot_tell for one in (*by_world["real"], *by_world["dream"])} == {None}
    assert found.agreement("hesitant")["reach"]["not_comparable"] == ["script"]


def rate(report, policy, world):
    return np.mean([s.success for s in report.scores if (s.policy, s.world) == (policy, world)])


def test_every_policy_from_every_start_in_every_world(report, policies):
    assert len(report.scores) == 2 * len(SEEDS) * len(policies) * 4
    assert len({s.start_digest for s in report.scores}) == 2 * len(SEEDS)
    for world in ("real", "dream", "nightmare", "copy-first"):
        assert report.outcomes(world, "reach").shape == (4, len(SEEDS))


def test_real_success_is_the_judge_s(report):
    assert rate(report, "script", "real") == 1.0
    assert rate(report, "hold", "real") == np.mean(
        [np.linalg.norm(toy.target_m(t, s)) < toy.REACHED_M for t in toy.TASKS for s in SEEDS]
    )
    assert rate(report, "cloned", "real") > rate(report, "hold", "real")


def test_a_faithful_world_agrees_and_a_false_one_does_not(report):
    dream, nightmare = report.agreement("dream"), report.agreement("nightmare")
    for task in toy.TASKS:
        assert dream[task]["pearson"] >= 0.6
        assert dream[task]["mean_absolute_error"] < nightmare[task]["mean_absolute_error"]
    assert rate(report, "script", "copy-first") <= 0.25


def test_probe_is_judged_by_the_real_outcomes(report):
    assert report.to_report()["probe_accuracy_on_real"] >= 0.8


def test_the_real_world_alone_is_enough(client, probe):
    found = evaluate(
        real=WorldAddress(client, "judge"),
        imagined={},
        policies={"hold": HoldPolicy()},
        plan=EvaluationPlan({"reach": ""}, [2000], num_steps=16),
        probe=probe,
    )
    assert [score.world for score in found.scores] == ["real"]
    assert found.to_report()["agreement"] == {}


def test_rubric_scores_by_reported_and_by_probable_milestones(client, policies, probe):
    criterion = {"name": "near", "points": 2, "description": "Near.", "milestone": "near"}
    rubrics = {"reach": Rubric.model_validate({"criteria": [criterion]})}
    worlds = StudyWorlds.ask(WorldAddress(client, "reporting"), addresses(client, "dream"))

    class Unsure(SuccessClassifier):
        def __init__(self):
            """Nothing trained."""

        def verdict(self, ending):
            milestones = {"near": 0.25, "far": 1.0}
            return Verdict(0.5, "cannot tell", likely_success=True, milestones=milestones)

    runner = RolloutRunner(worlds, probe, 80, own_probes={"dream": Unsure()}, rubrics=rubrics)

    def scored(policy, world, task="reach"):
        start = matched_start(worlds.addresses["real"], task, SEEDS[0], "")
        return runner.run(start, policies[policy], policy, world)[0].rubric_score

    assert scored("script", "real") == 1.0
    assert scored("hold", "real") == 0.0
    assert scored("hold", "dream") == 0.25
    # A world that reports nothing, a probe that classifies none, a task without a rubric.
    assert scored("hold", "real", task="reach far") is None
    silent = StudyWorlds.ask(WorldAddress(client, "judge"), addresses(client, "dream"))
    runner = RolloutRunner(silent, probe, 80, rubrics=rubrics)
    assert scored("script", "real") is None
    assert scored("script", "dream") is None


def test_an_ending_that_cannot_be_judged_is_a_failed_rollout(client, probe, monkeypatch):
    def verdict(_, ending):
        raise ShapeError(f"tactile of {ending.task}: got 138 taxels")

    monkeypatch.setattr(SuccessClassifier, "verdict", verdict)
    worlds = StudyWorlds.ask(WorldAddress(client, "judge"), {})
    start = matched_start(worlds.addresses["real"], "reach", SEEDS[0], "")
    failed, played = RolloutRunner(worlds, probe, 16).run(start, HoldPolicy(), "hold", "real")
    assert (failed.error, failed.message) == ("ShapeError", "tactile of reach: got 138 taxels")
    assert played is None


class SeesAll(BehaviourCloningPolicy):
    """The same policy, to which worlds show every step."""

    uses_images = True


def test_a_policy_that_looks_last_scores_as_if_it_saw_every_step(client, probe, policy_checkpoint):
    found = evaluate(
        real=WorldAddress(client, "judge"),
        imagined=addresses(client, "dream"),
        policies={
            "last": BehaviourCloningPolicy(policy_checkpoint),
            "all": SeesAll(policy_checkpoint),
        },
        plan=EvaluationPlan({"reach": ""}, [2000, 2001]),
        probe=probe,
    )
    assert not found.failures
    by_policy = {
        name: [
            (s.world, s.seed, s.success, s.probability) for s in found.scores if s.policy == name
        ]
        for name in ("last", "all")
    }
    assert len(by_policy["last"]) == 4
    assert by_policy["last"] == by_policy["all"]


class Choosy(toy.ToyWorld):
    """A judge that does not begin from one seed."""

    def reset(self, start):
        if start.seed == 2001:
            raise InvalidInputError("toy: nothing to reach here")
        return super().reset(start)


def test_a_start_that_fails_costs_its_own_rollouts_only(client, probe):
    found = evaluate(
        real=WorldAddress(client, "choosy"),
        imagined=addresses(client, "dream"),
        policies={"hold": HoldPolicy()},
        plan=EvaluationPlan({"reach": ""}, SEEDS, num_steps=16),
        probe=probe,
    )
    assert {(f.world, f.seed) for f in found.failures} == {("real", 2001), ("dream", 2001)}
    assert "nothing to reach here" in found.failures[0].message
    assert len(found.scores) == 4


def test_a_world_that_goes_away_midway_is_missing_from_then_on(client, probe, monkeypatch):
    monkeypatch.setattr(http_link, "RETRY_PAUSES_S", ())
    kept = []
    with ExitStack() as away:
        app = create_world_app({"far": toy.ToyWorld("far", judge=False)}, WorldServiceSettings())
        far = away.enter_context(RolloutClient(away.enter_context(served(app)), patience_s=0.0))

        def keep(outcome):
            kept.append(outcome)
            if len(kept) == 2:
                away.close()

        found = evaluate(
            real=WorldAddress(client, "judge"),
            imagined={"far": WorldAddress(far, "far")},
            policies={"hold": HoldPolicy()},
            plan=EvaluationPlan({"reach": ""}, SEEDS, num_steps=16),
            probe=probe,
            keep=keep,
        )
    assert [(f.world, f.seed, f.error) for f in found.failures] == [
        ("far", 2001, "UnavailableError"),
        ("far", 2002, "UnavailableError"),
    ]
    assert len(found.scores) == 4
    assert found.agreement("far")["reach"]["num_starts"] == 1


def test_training_starts_are_refused(client, probe, policies, demonstrations):
    seen = next(
        d.seed
        for d in demonstrations
        if d.start_digest in probe.metadata.training_starts and d.task == "reach"
    )
    asked = {
        "real": WorldAddress(client, "judge"),
        "imagined": addresses(client, "dream"),
        "policies": {"hold": HoldPolicy()},
        "probe": probe,
    }
    instructions = {"reach": toy.INSTRUCTIONS["reach"]}
    with pytest.raises(ConflictError, match="trained on by the success classifier"):
        evaluate(plan=EvaluationPlan(instructions, [2000, seen]), **asked)
    digest = matched_start(asked["real"], "reach", 2000, "").digest
    plan = EvaluationPlan(instructions, [2000], trained_on={"the world model": {digest}})
    with pytest.raises(ConflictError, match="the world model"):
        evaluate(plan=plan, **asked)


def test_a_real_world_that_does_not_repeat_itself_has_no_scores(client, probe):
    found = evaluate(
        real=WorldAddress(client, "forgetful"),
        imagined=addresses(client, "dream"),
        policies={"h": HoldPolicy()},
        plan=EvaluationPlan({"reach": ""}, [2000], num_steps=16),
        probe=probe,
    )
    assert [failure.world for failure in found.failures] == ["real"]
    assert "began differently" in found.failures[0].message
    assert found.to_report()["policies"][0]["real"] == "undefined"


@pytest.mark.parametrize(
    ("real", "imagined", "num_steps", "message"),
    [
        ("dream", "dream", 16, "does not report success"),
        ("judge", "judge", 16, "starts from task_seed"),
        ("judge", "wide", 16, "camera_wrist_left"),
        ("judge", "dream", 18, "multiple of 4"),
        ("judge", "small glove", 16, "'real' 'dextouch_v1' .320.*'small glove' 'small' .138"),
    ],
)
def test_worlds_that_do_not_fit_are_refused_before_the_first_rollout(
    client, probe, real, imagined, num_steps, message
):
    kept = []
    with pytest.raises(InvalidInputError, match=message):
        evaluate(
            real=WorldAddress(client, real),
            imagined=addresses(client, imagined),
            policies={"h": HoldPolicy()},
            plan=EvaluationPlan(toy.INSTRUCTIONS, [2000], num_steps=num_steps),
            probe=probe,
            keep=kept.append,
        )
    assert kept == []


class Watching(HoldPolicy):
    """Notes what it is shown."""

    uses_images = True

    def __init__(self, chunk_steps):
        super().__init__()
        self.chunk_steps = chunk_steps

    def reset(self, start):
        super().reset(start)
        self.seen = getattr(self, "seen", [])

    def act(self, observation):
        self.seen.append((len(observation), set(observation.images)))
        return super().act(observation)[: self.chunk_steps]


def test_cameras_are_those_that_every_world_has(client, probe):
    """The real world shows more than the model knows; the baseline beside it wants all of it."""
    policy = Watching(chunk_steps=12)
    found = evaluate(
        real=WorldAddress(client, "wide judge"),
        imagined=addresses(client, "dream", "wide copy-first"),
        policies={"hold": policy},
        plan=EvaluationPlan({"reach": ""}, [2000], num_steps=32),
        probe=probe,
    )
    assert found.failures == ()
    assert len(found.scores) == 3
    # 12 + 12 + 8 steps: the last chunk is cut, so that all policies act equally long.
    assert policy.seen == [(1, {"camera_head"}), (12, {"camera_head"}), (12, {"camera_head"})] * 3


class NotLooking(Watching):
    """The same, without eyes."""

    uses_images = False


@pytest.mark.parametrize("chunk_steps", [12, 16])
def test_a_policy_that_does_not_look_ends_as_if_it_did(client, probe, chunk_steps):
    """The judge sees the same endings, and the policy no image but the first."""
    blind = NotLooking(chunk_steps=chunk_steps)
    asked = {
        "real": WorldAddress(client, "judge"),
        "imagined": addresses(client, "dream"),
        "plan": EvaluationPlan({"reach": ""}, [2000], num_steps=32),
        "probe": probe,
    }
    found = evaluate(policies={"hold": blind}, **asked)
    assert found == evaluate(policies={"hold": Watching(chunk_steps=chunk_steps)}, **asked)
    assert found.failures == ()
    assert [images for _, images in blind.seen][:2] == [{"camera_head"}, set()]


class Fragile(HoldPolicy):
    """Falls over in one task and seed, in its second chunk."""

    def reset(self, start):
        super().reset(start)
        self.fragile = (start.task, start.seed) == ("reach", 2001)

    def act(self, observation):
        if self.fragile and observation.first_step:
            raise ZeroDivisionError("no idea")
        return super().act(observation)


def test_a_failing_rollout_is_a_row_and_the_rest_goes_on(client, probe):
    kept = []
    report = evaluate(
        real=WorldAddress(client, "judge"),
        imagined=addresses(client, "dream"),
        policies={"fragile": Fragile(), "hold": HoldPolicy()},
        plan=EvaluationPlan(toy.INSTRUCTIONS, SEEDS, num_steps=32),
        probe=probe,
        keep=kept.append,
    )
    assert len(kept) == 2 * 2 * 2 * len(SEEDS)
    assert [(f.policy, f.task, f.seed, f.world) for f in report.failures] == [
        ("fragile", "reach", 2001, "real"),
        ("fragile", "reach", 2001, "dream"),
    ]
    failure = report.failures[0]
    assert failure.message == (
        "policy 'fragile', task 'reach', seed 2001, chunk 1: act raised ZeroDivisionError: no idea"
    )
    assert 'raise ZeroDivisionError("no idea")' in failure.traceback
    assert "asking.py" not in failure.traceback
    whole = report.to_report()
    row = next(r for r in whole["policies"] if (r["policy"], r["task"]) == ("fragile", "reach"))
    assert (row["real_rollouts"], row["real_failed"]) == (len(SEEDS) - 1, 1)
    # Agreement is of starts that every policy ended in both worlds.
    assert whole["agreement"]["reach"]["num_starts"] == len(SEEDS) - 1
    assert whole["agreement"]["reach far"]["num_starts"] == len(SEEDS)


def test_nothing_to_evaluate_and_unknown_worlds_are_refused(client, probe):
    real = WorldAddress(client, "judge")
    plan = EvaluationPlan(toy.INSTRUCTIONS, [2000])
    with pytest.raises(InvalidInputError, match="0 policies"):
        evaluate(real=real, imagined={"d": real}, policies={}, plan=plan, probe=probe)
    with pytest.raises(UnknownNameError, match="atlantis"):
        evaluate(
            real=real,
            imagined=addresses(client, "atlantis"),
            policies={"hold": HoldPolicy()},
            plan=EvaluationPlan({"reach": ""}, [2000], num_steps=16),
            probe=probe,
        )
