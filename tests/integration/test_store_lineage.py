"""What a station says about a take is found again in the catalog's row of its episode."""

from types import SimpleNamespace

import numpy as np
import pytest

from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import RecordingAttributes
from services.alignment.synchronization.episode_builder import _episode_attributes


def test_station_operator_and_figures_are_taken_over():
    source = RecordingAttributes(
        recording_id="take-1",
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        operator="ada",
        recovered=True,
        calibration={"K_head": ((60.0, 0.0, 16.0), (0.0, 60.0, 16.0), (0.0, 0.0, 1.0))},
        quality={"coverage": 0.9, "num_steps_refused": 7.0},
    )
    recording = SimpleNamespace(attributes=source, content_sha256="0" * 64)
    actions = SimpleNamespace(anchor=AnchorPoses(np.eye(4), np.eye(4), np.eye(4)), absent=())
    build = getattr(_episode_attributes, "__wrapped__", _episode_attributes)
    episode = build(recording, "take-1-x", actions, {}, {"num_steps_refused": 2.0})
    assert (episode.station, episode.operator, episode.recovered) == ("bench", "ada", True)
    # A figure of the episode itself counts more than the take's.
    assert episode.quality == {"coverage": pytest.approx(0.9), "num_steps_refused": 2.0}
