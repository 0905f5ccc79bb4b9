"""Report pictures of stored episodes."""

import numpy as np

from dextouch.episodes import EpisodeReader
from dextouch.streams import HEAD_CAMERA
from services.evaluation.reporting.pictures import ActionPicture, EpisodePicture


def episode_picture(reader: EpisodeReader, *, num_moments: int = 8) -> EpisodePicture:
    """Evenly spaced moments of a whole episode, including the first and the last."""
    window = reader.window(0, num_steps=reader.num_steps, cameras=(HEAD_CAMERA,))
    steps = np.unique(np.linspace(0, reader.num_steps - 1, num_moments).round().astype(int))
    attributes = reader.attributes
    outcome = {True: "success", False: "failure", None: "outcome unknown"}[attributes.success]
    return EpisodePicture(
        f"{attributes.task}, {attributes.domain}, {attributes.origin}: {outcome}",
        _seconds(window.t_ref_ns)[steps],
        window.images[HEAD_CAMERA][steps],
        window.tactile_kpa[steps],
    )


def action_picture(reader: EpisodeReader) -> ActionPicture:
    """Actions of a whole episode, including commanded ones where available."""
    window = reader.window(0, num_steps=reader.num_steps, cameras=())
    commanded = None
    if "action_commanded" in reader.streams:
        commanded = reader.read("action_commanded").values
    return ActionPicture(_seconds(window.t_ref_ns), window.actions, commanded)


def _seconds(t_ref_ns: np.ndarray) -> np.ndarray:
    """Seconds since the first timestamp; subtracted in int64 first."""
    return (t_ref_ns - t_ref_ns[0]) / 1e9
