"""A test double of an episode on the model grid: its arrays are in memory, none in a store."""

from dataclasses import dataclass, fields, replace

import numpy as np

from dextouch.episodes import EpisodeGrid, ObjectTrack, measured_taxels
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ActionKind, EpisodeAttributes
from dextouch.tactile import DEXTOUCH_V1


@dataclass(kw_only=True)
class ToyGrid(EpisodeGrid):
    tactile_layout = DEXTOUCH_V1
    about: EpisodeAttributes
    anchor: AnchorPoses
    measured: np.ndarray
    sent: np.ndarray
    K_head: np.ndarray
    tactile_kpa: np.ndarray
    objects: ObjectTrack
    boxes_m: np.ndarray
    pictures: np.ndarray
    image_steps: np.ndarray
    action_kind: ActionKind = "commanded"

    def __len__(self):
        return len(self.sent)

    @property
    def image_size_px(self):
        return self.pictures.shape[1:3]

    @property
    def content_sha256(self):
        return self.about.episode_id

    @property
    def measured_taxels(self):
        return measured_taxels(self.about.calibration, self.tactile_layout.num_taxels)

    def touch(self):
        return self.tactile_kpa, np.ones(self.tactile_kpa.shape[:2], dtype=bool)

    def images(self, steps):
        return self.pictures[np.searchsorted(self.image_steps, steps)]


def changed(one, **values):
    """A toy with other attributes, object poses or arrays."""
    in_track = {name: values.pop(name) for name in ("poses", "known", "sources", "sd_m")
                if name in values}  # fmt: skip
    own = {field.name for field in fields(one)}
    in_about = {name: values.pop(name) for name in list(values) if name not in own}
    return replace(
        one,
        about=one.about.model_copy(update=in_about),
        objects=replace(one.objects, **in_track),
        **values,
    )
