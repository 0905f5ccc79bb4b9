"""Matching samples with true ones: drops counted, long delays found, rest not guessed at."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from dextouch.episodes import StreamData
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor
from services.alignment.recording_error import NEAR_NS, match_samples

PERIOD_NS = 10_000_000
EYE = matrix_rows(np.eye(4))
ATTRIBUTES = EpisodeAttributes(
    episode_id="fake",
    task="any",
    instruction="",
    domain="robot",
    origin="twin",
    anchor=StoredAnchor(T_world_wrist_left=EYE, T_world_wrist_right=EYE, T_world_camera_head=EYE),
    K_head=matrix_rows(np.eye(3)),
)


@dataclass
class FakeEpisode:
    t_ns: np.ndarray
    values: np.ndarray
    attributes: EpisodeAttributes = ATTRIBUTES
    streams: dict[str, StreamDescriptor] = field(default_factory=dict)

    def __post_init__(self):
        self.streams["head"] = StreamDescriptor(
            name="head", kind="pose", shape=(3,), dtype="float64", unit="m", nominal_rate_hz=100
        )

    def read(self, name):
        return StreamData(self.t_ns, self.values)


def truth_and_copy(delay_ns, *, moving):
    t_ns = np.arange(300, dtype=np.int64) * PERIOD_NS
    values = np.sin(t_ns[:, None] * 1e-9 * np.array([3.0, 5.0, 7.0])) * moving
    rng = np.random.default_rng(0)
    kept = rng.random(300) > 0.05
    kept[[0, -1]] = True
    noisy = (values + rng.normal(scale=1e-3, size=values.shape))[kept]
    return FakeEpisode(t_ns, values), FakeEpisode(t_ns[kept] + delay_ns, noisy), kept


@pytest.mark.parametrize("delay_ns", [0, 300_000, 7_000_000, 42_000_000, -33_000_000])
def test_constant_delay_of_many_periods_is_found(delay_ns):
    truth, episode, kept = truth_and_copy(delay_ns, moving=1.0)
    match = match_samples(episode, truth, "head", 0, NEAR_NS)
    assert match.mean_offset_ns == delay_ns
    assert match.rms_ms == 0
    assert match.num_dropped == (~kept).sum()


def test_what_rests_is_matched_by_time_alone():
    truth, episode, _ = truth_and_copy(1_000_000, moving=0.0)
    assert match_samples(episode, truth, "head", 0, NEAR_NS).mean_offset_ns == 1_000_000
