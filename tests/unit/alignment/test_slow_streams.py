"""The longest gap that is interpolated follows the rate of each stream."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization.episode_builder import build_episode
from tests.unit.alignment.recordings import K_HEAD, POSE

SECONDS = 4
# Of 4 s at 15 Hz, which the slow stream covers but for its last period at most.
ALL_STEPS = range(58, 62)


def steps_of(folder, rate_hz, lost=(), **options):
    """Steps of the episode of a robot whose head is tracked at a rate, some samples lost."""
    store = EpisodeStore(folder)
    attributes = RecordingAttributes(
        recording_id="take", task="t", instruction="", domain="robot", station="s",
        started_t_host_ns=0, calibration={"K_head": K_HEAD},
    )  # fmt: skip
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name in ("wrist_left", "wrist_right", "head", "joints_measured"):
            rate = rate_hz if name == "head" else 100
            number = np.arange(SECONDS * rate + 1)
            if name == "head":
                number = np.delete(number, lost)
            t_ns = np.rint(number * 1e9 / rate).astype(np.int64)
            is_pose = name != "joints_measured"
            row = POSE if is_pose else np.full(40, 0.25)
            writer.add_stream(
                StreamDescriptor(
                    name=name,
                    kind="pose" if is_pose else "robot_state",
                    shape=row.shape,
                    dtype="float64",
                    unit="pose_m_wxyz" if is_pose else "rad",
                    nominal_rate_hz=rate,
                )
            )
            values = np.repeat(row[None], len(number), axis=0)
            writer.append(
                name, values=values, t_host_ns=t_ns + 10**12, t_device_ns=t_ns, sequence=number
            )
    built = build_episode(
        store.recording("take"), episode_id="e", options=AlignmentOptions(**options)
    )
    (action,) = (stream for stream in built.streams if stream.descriptor.name == "action")
    return sum(len(block.t_ns) for block in action.blocks), built.attributes.quality


@pytest.mark.parametrize(
    ("rate_hz", "lost"), [(30, [60]), (30, [20, 60, 61 + 20]), (25, [40]), (15, []), (15, [30])]
)
def test_a_slow_stream_may_lose_a_sample(tmp_path, rate_hz, lost):
    num_steps, quality = steps_of(tmp_path, rate_hz, lost)
    assert num_steps in ALL_STEPS
    assert quality["head_num_gaps"] == 0


@pytest.mark.parametrize(("rate_hz", "lost"), [(30, [60, 61]), (100, range(200, 205))])
def test_longer_gaps_still_part_the_take(tmp_path, rate_hz, lost):
    num_steps, quality = steps_of(tmp_path, rate_hz, lost, max_bridged_ms=0)
    assert num_steps <= 31
    assert quality["head_num_gaps"] == 1
    assert quality["num_steps_interpolated"] == 0
