"""Pictures of stored episodes for the report."""

import numpy as np

from dextouch.episodes import EpisodeReader
from services.evaluation.demonstrations import CAMERA
from services.evaluation.reporting.pictures import ActionPicture, EpisodePicture


def episode_picture(reader: EpisodeReader, *, num_moments: int = 8) -> EpisodePicture:
    """Evenly spread moments of a whole episode, the first and the last among them."""
    window = reader.window(0, num_steps=reader.num_steps, cameras=(CAMERA,))
    steps = np.unique(np.linspace(0, reader.num_steps - 1, num_moments).round().astype(int))
    attributes = reader.attributes
    outcome = {True: "success", False: "failure", None: "outcome unknown"}[attributes.success]
    return EpisodePicture(
        f"{attributes.task}, {attributes.domain}, {attributes.origin}: {outcome}",
        _seconds(window.t_ref_ns)[steps],
        window.images[CAMERA][steps],
        window.tactile_kpa[steps],
    )


def action_picture(reader: EpisodeReader) -> ActionPicture:
    """The actions of a whole episode, commanded ones too where it has them."""
    window = reader.window(0, num_steps=reader.num_steps, cameras=())
    commanded = None
    if "action_commanded" in reader.streams:
        commanded = reader.read("action_commanded").values
    return ActionPicture(_seconds(window.t_ref_ns), window.actions, commanded)


def _seconds(t_ref_ns: np.ndarray) -> np.ndarray:
    """Seconds since the first stamp; subtracted in int64 first."""
    return (t_ref_ns - t_ref_ns[0]) / 1e9
