"""Streams of a stored episode, ready to be played by mock devices."""

from dextouch.episodes import EpisodeReader
from dextouch.schemas import Matrix
from services.acquisition.mocks.replay import ReplayStream

PLAYED_KINDS = ("tactile", "keypoints", "pose", "image", "robot_state")


def replay_streams(reader: EpisodeReader) -> list[ReplayStream]:
    """Every stream of the episode that a device could have sent."""
    streams = []
    for name, descriptor in reader.streams.items():
        if descriptor.kind not in PLAYED_KINDS or name == "object_poses":
            continue
        data = reader.read(name)
        plain = descriptor.model_copy(update={"unit": "rgb8"})
        wanted = plain if descriptor.kind == "image" else descriptor
        streams.append(ReplayStream(wanted, data.t_ref_ns, data.values))
    return streams


def replay_calibration(reader: EpisodeReader) -> dict[str, Matrix]:
    """What the episode knows of its cameras and mounts."""
    return {**reader.attributes.calibration, "K_head": reader.attributes.K_head}
