"""An aligned episode in, the short account of it that people and programs read out."""

from pydantic import BaseModel, ConfigDict, FiniteFloat

from dextouch.episodes import EpisodeReader
from dextouch.schemas.episodes import ClockReport, Domain

EXPECTED_STREAMS = (
    "tactile_left",
    "tactile_right",
    "camera_head",
    "camera_wrist_left",
    "camera_wrist_right",
)


class AlignmentReport(BaseModel):
    """What became of a recording.

    `created` is False where the same recording had been aligned with the same options before.
    `absent` lists streams that an episode may have and this one has not.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording_id: str
    episode_id: str
    created: bool
    domain: Domain
    num_steps: int
    streams: dict[str, int]
    absent: tuple[str, ...]
    clocks: tuple[ClockReport, ...]
    quality: dict[str, FiniteFloat]
    content_sha256: str


def report_of(episode: EpisodeReader, *, recording_id: str, created: bool) -> AlignmentReport:
    """The report of an episode that alignment wrote."""
    attributes = episode.attributes
    return AlignmentReport(
        recording_id=recording_id,
        episode_id=attributes.episode_id,
        created=created,
        domain=attributes.domain,
        num_steps=episode.num_steps,
        streams={name: episode.num_samples(name) for name in episode.streams},
        absent=tuple(name for name in EXPECTED_STREAMS if name not in episode.streams),
        clocks=attributes.clocks,
        quality=attributes.quality,
        content_sha256=episode.content_sha256,
    )
