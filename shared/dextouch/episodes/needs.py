"""What learners need of an episode, and how to get it; for `dextouch.episodes.select_episodes`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from dextouch.episodes.object_poses import has_object_poses
from dextouch.episodes.reader import EpisodeReader
from dextouch.streams import HEAD_CAMERA


@dataclass(frozen=True)
class Need:
    """Something that an episode must have to be fit for a learner.

    `lack` says in messages what episodes are like that do not have it, and `remedy` how to get it.
    `is_choice` marks those that choose among good episodes: what they leave out is no loss.
    """

    lack: str
    remedy: str
    is_met: Callable[[EpisodeReader], bool]
    is_choice: bool = False


ACTIONS: Final = Need(
    "without actions", "align them from a recording", lambda reader: reader.num_steps > 0
)
EVERY_PART: Final = Need(
    "without a hand, a finger, or the pose or matrix of the head camera",
    "track both hands and the head, and calibrate the head camera",
    lambda reader: not reader.attributes.absent and reader.attributes.K_head is not None,
)
WHOLE: Final = Need(
    "cut short when their writer died",
    "record them again: an outcome is that of the whole take",
    lambda reader: not reader.attributes.recovered,
)
OUTCOME: Final = Need(
    "of unknown outcome",
    "the operator enters it after a take, docs/dashboard.md",
    lambda reader: reader.attributes.success is not None,
)
SUCCESS: Final = Need(
    "that failed",
    "only successes are taken",
    lambda reader: bool(reader.attributes.success),
    is_choice=True,
)
TOUCH: Final = Need(
    "without touch of both hands",
    "record both gloves",
    lambda reader: {"tactile_left", "tactile_right"} <= set(reader.streams),
)
OBJECTS: Final = Need(
    "without poses of their objects",
    "measure them by markers or trackers, or click on them, docs/objects.md",
    has_object_poses,
)
IMAGES: Final = Need(
    "without images of the head camera",
    "record the head camera",
    lambda reader: HEAD_CAMERA in reader.streams and reader.num_samples(HEAD_CAMERA) > 0,
)
FIRST_IMAGE: Final = Need(
    "without an image of their first step",
    "record the head camera from the start",
    lambda reader: _has_images(reader, range(1)),
)
EVERY_IMAGE: Final = Need(
    "without an image of nearly every step",
    "record images of every step, in the twin by `dextouch train data --images 1`",
    lambda reader: IMAGES.is_met(reader) and reader.has_every_image(HEAD_CAMERA),
)


def image_every(stride: int) -> Need:
    """Need of an image of every `stride`-th step, the first one included."""
    return Need(
        f"without an image of every {stride}th step",
        f"record images as often, in the twin by `dextouch train data --images {stride}`",
        lambda reader: _has_images(reader, range(0, reader.num_steps, stride)),
    )


def longer_than(num_steps: int) -> Need:
    """Need of more than a number of steps."""
    return Need(
        f"of at most {num_steps} steps",
        "record longer takes",
        lambda reader: reader.num_steps > num_steps,
    )


def _has_images(reader: EpisodeReader, steps: range) -> bool:
    if not IMAGES.is_met(reader):
        return False
    return len(reader.shown_steps(HEAD_CAMERA, np.array(steps))[0]) == len(steps)
