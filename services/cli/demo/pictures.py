"""Pictures of takes and predictions for the demo's report."""

import numpy as np

from dextouch.episodes import EpisodeReader
from services.cli.demo.recording import Take
from services.evaluation.reporting import (
    ActionPicture,
    EpisodePicture,
    PredictionPicture,
    ReportPictures,
)

NUM_MOMENTS = 7
CAMERA = "camera_head"


def collect(takes: dict[str, Take], predictions: tuple[PredictionPicture, ...]) -> ReportPictures:
    """Collect all pictures of the report."""
    robot = takes["robot"].episode
    return ReportPictures(
        episodes=tuple(
            _strip(take.episode, f"{name.capitalize()} take, as recorded and aligned")
            for name, take in takes.items()
        ),
        clock_residuals_ms=takes["human"].clock_residuals_ms,
        actions=_actions(robot),
        predictions=predictions,
    )


def _strip(episode: EpisodeReader, title: str) -> EpisodePicture:
    steps = np.linspace(0, episode.num_steps - 1, NUM_MOMENTS).astype(int)
    window = episode.window(0, episode.num_steps, cameras=(CAMERA,))
    return EpisodePicture(
        title=f"{title}: {episode.attributes.instruction}",
        times_s=(window.t_ref_ns[steps] - window.t_ref_ns[0]) * 1e-9,
        images=window.images[CAMERA][steps],
        tactile_kpa=window.tactile_kpa[steps],
    )


def _actions(episode: EpisodeReader) -> ActionPicture:
    measured = episode.window(0, episode.num_steps, cameras=())
    commanded = None
    if "action_commanded" in episode.streams:
        commanded = episode.window(
            0, episode.num_steps, cameras=(), action_kind="commanded"
        ).actions
    times_s = (measured.t_ref_ns - measured.t_ref_ns[0]) * 1e-9
    return ActionPicture(times_s, measured.actions, commanded)
