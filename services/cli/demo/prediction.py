"""Held-out episodes and a checkpoint in; how well images and touch are foreseen, out."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from dextouch.episodes import EpisodeStore
from services.evaluation.reporting import PredictionPicture
from services.world_model.checkpoints import Checkpoint
from services.world_model.training.dataset import cut_window
from services.world_model.training.episodes import read_episode
from services.world_model.training.evaluation import evaluate_prediction, predict_all

SHOWN_STEPS = (1, 4, 8, 12, 16)
SHOWN_START = 16


@dataclass(frozen=True)
class PredictionResult:
    """Figures as `report.json` holds them, and one window a task to look at."""

    figures: dict[str, Any]
    pictures: tuple[PredictionPicture, ...]


def measure_prediction(
    checkpoint: Checkpoint, store: EpisodeStore, episode_ids: list[str]
) -> PredictionResult:
    """Errors over every stride-8 window of held-out episodes, with commanded actions.

    Args:
        checkpoint: of the world model.
        store: where the episodes are.
        episode_ids: none of which was trained on (refused by content otherwise).
    """
    episodes = [read_episode(store.open(episode_id)) for episode_id in episode_ids]
    figures = evaluate_prediction(
        checkpoint.model, episodes, train_fingerprints=checkpoint.metadata.train_fingerprints
    )
    pictures = []
    for task in dict.fromkeys(episode.task for episode in episodes):
        episode = next(episode for episode in episodes if episode.task == task)
        window = cut_window(episode, SHOWN_START, 17, action_kind="commanded")
        future = predict_all(checkpoint.model, [window.request], seed=0)
        shown = np.array(SHOWN_STEPS)
        pictures.append(
            PredictionPicture(
                title=f"{episode.instruction} One second ahead, from its first image and touch.",
                times_s=shown / episode.model_rate_hz,
                true_images=window.images[shown],
                predicted_images=future.images[0][shown - 1],
                true_tactile_kpa=window.tactile_kpa[shown],
                predicted_tactile_kpa=future.tactile_kpa[0][shown - 1],
            )
        )
    return PredictionResult(dict(figures), tuple(pictures))
