"""Report of an alignment: clocks, retargeting quality and parts that are not in the episode."""

from collections.abc import Mapping

import numpy as np
from pydantic import Field, FiniteFloat

from dextouch.episodes import EpisodeReader
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ClockReport, Domain, Matrix
from dextouch.tactile.layout import SIDES
from services.alignment.calibration.tactile_baseline import REASONS
from services.alignment.synchronization.refused_parts import RefusedPart, refused_parts

EXPECTED_STREAMS = (
    "tactile_left",
    "tactile_right",
    "camera_head",
    "camera_wrist_left",
    "camera_wrist_right",
)


class AlignmentReport(FrozenModel):
    """Report of one aligned recording.

    `created` is False where the same recording had been aligned with the same options before.
    `duration_s` is that of the model grid. `absent` lists streams that an episode may have and this
    one has not; `refused_parts` the stretches of the recording that are not in the episode, and
    why; `retargeting` figures of each hand: tip error (mean and 95th percentile, mm) and the share
    of steps by status. `refused_taxels` names, by stream and reason, taxels (anatomical order) that
    are zero because they were not measured.
    """

    recording_id: str
    episode_id: str
    created: bool
    domain: Domain
    num_steps: int
    duration_s: float = Field(default=0.0, ge=0)
    streams: dict[str, int]
    absent: tuple[str, ...]
    clocks: tuple[ClockReport, ...]
    quality: dict[str, FiniteFloat]
    retargeting: dict[str, dict[str, FiniteFloat]] = Field(default={})
    refused_parts: tuple[RefusedPart, ...] = ()
    refused_taxels: dict[str, dict[str, tuple[int, ...]]] = Field(default={})
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
        duration_s=episode.num_steps / attributes.model_rate_hz,
        streams={name: episode.num_samples(name) for name in episode.streams},
        absent=tuple(name for name in EXPECTED_STREAMS if name not in episode.streams),
        clocks=attributes.clocks,
        quality=attributes.quality,
        retargeting=_retargeting_figures(attributes.quality),
        refused_parts=refused_parts(attributes.calibration),
        refused_taxels=_refused_taxels(attributes.calibration),
        content_sha256=episode.content_sha256,
    )


def _retargeting_figures(quality: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """By side; empty where nothing was retargeted."""
    found: dict[str, dict[str, float]] = {}
    for name, value in quality.items():
        for side in SIDES:
            figure = name.removeprefix(f"retargeting_{side}_")
            if figure != name:
                found.setdefault(side, {})[figure] = value
    return found


def _refused_taxels(calibration: Mapping[str, Matrix]) -> dict[str, dict[str, tuple[int, ...]]]:
    """By stream and reason."""
    found: dict[str, dict[str, tuple[int, ...]]] = {}
    for name in ("tactile_left", "tactile_right"):
        states = np.array(calibration.get(f"{name}_refused_taxels", ()), dtype=np.int64).ravel()
        for code in np.unique(states[states > 0]).tolist():
            taxels = tuple(np.flatnonzero(states == code).tolist())
            found.setdefault(name, {})[REASONS[code]] = taxels
    return found
