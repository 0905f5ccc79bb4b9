"""One rollout of every task in the real and in an imagined world, side by side, for a report."""

from collections.abc import Mapping

import numpy as np

from dextouch.clients import Policy
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.evaluation.closed_loop import EvaluationPlan, PlayedRollout, RolloutRunner
from services.evaluation.matched_starts import StudyWorlds, WorldAddress, matched_start
from services.evaluation.reporting import PredictionPicture
from services.evaluation.scores import REAL, ClosedLoopReport, RolloutScore
from services.evaluation.success_classifier import SuccessClassifier

Pair = tuple[RolloutScore, RolloutScore]


def film(
    report: ClosedLoopReport,
    *,
    real: WorldAddress,
    imagined: Mapping[str, WorldAddress],
    policies: Mapping[str, Policy],
    plan: EvaluationPlan,
    probe: SuccessClassifier,
) -> tuple[PredictionPicture, ...]:
    """Play the example pair of every task again, with the images of all steps.

    The evaluation renders only what policies and the success classifier use. The arguments are
    those of `evaluate`, and `report` what it returned; a pair that fails now is left out, and a
    robot is not moved for a picture.
    """
    if not imagined:
        return ()
    world = report.imagined_worlds[0]
    worlds = StudyWorlds.ask(real, {world: imagined[world]})
    if worlds.descriptions[REAL].kind == "robot":
        return ()
    runner = RolloutRunner(worlds, probe, plan.num_steps, shows_all=True)
    found = []
    for task, pair in example_pairs(report, world).items():
        name, instruction = pair[0].policy, plan.instructions[task]
        start = matched_start(real, task, pair[0].seed, instruction)
        played = [runner.run(start, policies[name], name, one)[1] for one in (REAL, world)]
        finished = [one for one in played if one is not None]
        if len(finished) == 2:
            description = worlds.descriptions[REAL]
            layout = TactileLayout.of(description.tactile_layout) or DEXTOUCH_V1
            found.append(_played_pair(pair, finished, description.model_rate_hz, layout))
    return tuple(found)


def example_pairs(report: ClosedLoopReport, world: str) -> dict[str, Pair]:
    """By task the first start and policy whose outcomes differ, or else succeed in both worlds."""
    known = {(s.world, s.task, s.policy, s.seed): s for s in report.scores if s.repeat == 0}
    found: dict[str, Pair] = {}
    for (where, task, policy, seed), score in known.items():
        imagined = known.get((world, task, policy, seed))
        if where != REAL or imagined is None:
            continue
        pair = (score, imagined)
        if task not in found or _rank(pair) > _rank(found[task]):
            found[task] = pair
    return found


def _rank(pair: Pair) -> tuple[bool, bool]:
    return pair[0].success != pair[1].success, pair[0].success


def title_of(pair: Pair) -> str:
    """Task, policy, start and both outcomes."""
    real, imagined = ("success" if one.success else "failure" for one in pair)
    task = pair[0].task.replace("_", " ")
    return f"{task}, {pair[0].policy}, start {pair[0].seed}: {real} in fact, {imagined} imagined"


def _played_pair(
    pair: Pair, played: list[PlayedRollout], rate_hz: float, layout: TactileLayout
) -> PredictionPicture:
    images = [np.concatenate([o.images[HEAD_CAMERA] for o in one.observations]) for one in played]
    touch = [np.concatenate([o.tactile_kpa for o in one.observations]) for one in played]
    steps = min(map(len, images))
    return PredictionPicture(
        title_of(pair),
        np.arange(steps) / rate_hz,
        images[0][:steps],
        images[1][:steps],
        touch[0][:steps],
        touch[1][:steps],
        layout,
    )
