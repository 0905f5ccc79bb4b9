"""The shipped success classifier on true endings near the border of success, recorded here."""

import sys
from dataclasses import replace

import pytest
import torch
from scipy.stats import mannwhitneyu

from dextouch.episodes import EpisodeStore
from dextouch.jobs import Workers
from services.evaluation.endings import read_ending_episodes
from services.evaluation.settings import DEFAULT_PROBE
from services.evaluation.success_classifier import SuccessClassifier
from services.pipelines.training_data import Scope, make_training_data
from services.twin.take_options import LADDER_M, MIXES

pytestmark = pytest.mark.slow
# Far from the seeds of training and of the checkpoint's own held-out set.
FIRST_SEED = 40_000
LEAST_AUC = 0.95
# Tasks whose true endings the committed probe tells less well than we want (docs/world_model.md).
LESS_SURE = {"stack_bowls": 0.70, "open_drawer": 0.80, "place_shoes": 0.85}


def test_it_tells_successes_from_near_misses(tmp_path):
    torch.set_num_threads(1)
    seeds = range(FIRST_SEED, FIRST_SEED + 4 * len(LADDER_M))
    probe = SuccessClassifier.load(DEFAULT_PROBE)
    scope = Scope(probe.metadata.tasks)
    make_training_data(str(tmp_path), seeds, MIXES["ladder"], workers=Workers(1), scope=scope)
    episodes = read_ending_episodes(EpisodeStore(tmp_path))
    assert not {e.start_digest for e in episodes} & set(probe.metadata.training_starts)
    for task in probe.metadata.tasks:
        mine = [e for e in episodes if e.task == task]
        told = probe.probabilities([replace(e.final, object_poses=None) for e in mine])
        wins, losses = ([p for p, e in zip(told, mine, strict=True) if e.success is outcome]
                        for outcome in (True, False))  # fmt: skip
        auc = mannwhitneyu(wins, losses).statistic / (len(wins) * len(losses))
        bound = LESS_SURE.get(task, LEAST_AUC)
        sys.stdout.write(
            f"\n{task}: {len(wins)} successes, {len(losses)} failures, AUC {auc:.3f} "
            f"| bound {bound}\n"
        )
        assert auc >= bound
