"""The closed loop over HTTP: matched starts, disjoint seeds, and scores that tell worlds apart."""

import numpy as np
import pytest

from dextouch.clients.rollouts import RolloutClient
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.worlds.baseline import CopyFirstWorld
from dextouch.worlds.serve import WorldServiceSettings, create_world_app
from services.evaluation.closed_loop import EvaluationPlan, WorldAddress, evaluate, matched_start
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.hold import HoldPolicy
from services.evaluation.policies.replay import ReplayPolicy
from services.evaluation.success_probe import SuccessProbe
from tests.unit.evaluation import toy
from tests.unit.worlds.running import served

SEEDS = range(2000, 2003)


class Forgetful(toy.ToyWorld):
    """A judge that never begins the same way twice."""

    def reset(self, start):
        self.count = getattr(self, "count", 0) + 1
        return super().reset(toy.replace(start, seed=start.seed + self.count))


@pytest.fixture(scope="module")
def client():
    judge = toy.ToyWorld("judge", judge=True)
    worlds = {
        "judge": judge,
        "dream": toy.ToyWorld("dream", judge=False),
        "nightmare": toy.ToyWorld("nightmare", judge=False, drift_m=0.05),
        "forgetful": Forgetful("forgetful", judge=True),
        "copy-first": CopyFirstWorld.beside(judge.description),
    }
    with served(create_world_app(worlds, WorldServiceSettings())) as url, RolloutClient(url) as it:
        yield it


@pytest.fixture(scope="module")
def probe(probe_checkpoint):
    return SuccessProbe(probe_checkpoint)


@pytest.fixture(scope="module")
def policies(policy_checkpoint):
    good = [toy.demonstration(t, s) for t in toy.TASKS for s in SEEDS]
    poor = [toy.demonstration(t, s, noise_m=0.08) for t in toy.TASKS for s in SEEDS]
    return {
        "script": ReplayPolicy.of(good),
        "clumsy script": ReplayPolicy.of(poor),
        "cloned": BehaviourCloningPolicy(policy_checkpoint),
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
    assert report.to_report()["probe_accuracy_on_real"] >= 0.85


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
    with pytest.raises(ConflictError, match="trained on by the success probe"):
        evaluate(plan=EvaluationPlan(instructions, [2000, seen]), **asked)
    digest = matched_start(asked["real"], "reach", 2000, "").digest
    plan = EvaluationPlan(instructions, [2000], trained_on={"the world model": {digest}})
    with pytest.raises(ConflictError, match="the world model"):
        evaluate(plan=plan, **asked)


def test_a_real_world_must_repeat_itself_and_judge(client, probe):
    asked = {"imagined": addresses(client, "dream"), "policies": {"h": HoldPolicy()}}
    plan = EvaluationPlan(toy.INSTRUCTIONS, [2000], num_chunks=1)
    with pytest.raises(ConflictError, match="began differently"):
        evaluate(real=WorldAddress(client, "forgetful"), plan=plan, probe=probe, **asked)
    with pytest.raises(InvalidInputError):
        evaluate(real=WorldAddress(client, "dream"), plan=plan, probe=probe, **asked)


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
            plan=EvaluationPlan({"reach": ""}, [2000], num_chunks=1),
            probe=probe,
        )
