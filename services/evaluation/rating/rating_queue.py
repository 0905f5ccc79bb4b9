"""Queue of rollouts to rate: blinded, balanced, in a different order for each rater."""

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.images import encode_jpeg
from dextouch.schemas import EpisodeAttributes, is_rollout
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.evaluation.rating.marks import (
    DECIDING,
    FIRST,
    REPEAT,
    Mark,
    MarkLog,
    StoredMark,
    by_people,
    vote,
)
from services.evaluation.rating.rubrics import Rubric
from services.evaluation.reporting.pictures import hands_image

# A rater is shown a rollout again after this many other marks, at least.
REPEAT_GAP: Final = 10
IMAGE_HEIGHT_PX: Final = 384
_BACKGROUND: Final = 24


@dataclass(frozen=True)
class RatedRollout:
    """A rollout as shown to raters, without the policy and the world.

    `token` stands for its episode in addresses, since ids of imagined episodes name their world.
    """

    token: str
    episode_id: str
    task: str
    instruction: str
    num_steps: int
    rate_hz: float


@dataclass(frozen=True)
class Assignment:
    """The rollout that a rater should rate next, and how many of theirs are done."""

    rollout: RatedRollout
    presentation: int
    num_done: int
    num_open: int


def token_of(episode_id: str) -> str:
    """Opaque token that stands for an episode's id in addresses."""
    return hashlib.sha256(f"rated rollout {episode_id}".encode()).hexdigest()[:20]


class RatingQueue:
    """Assigns rollouts to raters, until each has been rated by `raters_per_rollout` people.

    Rollouts with the fewest raters come first, in an order specific to the rater. When none is left
    for a rater, they decide those on which the others are tied, as two raters are wherever they
    differ, until one more rater of each has settled it.
    After every `1 / repeat_share` rollouts a rater is shown one again that they rated at least
    `REPEAT_GAP` marks ago. A repeated request without a mark returns the same rollout.
    """

    def __init__(
        self,
        rollouts: Iterable[RatedRollout],
        marks: MarkLog,
        *,
        raters_per_rollout: int = 5,
        repeat_share: float = 0.08,
    ) -> None:
        self._rollouts = {one.token: one for one in rollouts}
        self._marks = marks
        self._raters_per_rollout = raters_per_rollout
        self._repeat_share = repeat_share

    def rollout(self, token: str) -> RatedRollout:
        """The rollout behind an address; raises NotFoundError if there is none in this queue."""
        if token not in self._rollouts:
            raise NotFoundError(f"rollout {token!r}: not found among those to rate")
        return self._rollouts[token]

    def next(self, rater: str) -> Assignment | None:
        """The rollout that a rater should rate next; None when nothing is left."""
        latest = self._marks.latest()
        mine = sorted(
            (stored for stored in latest if stored.mark.rater == rater),
            key=lambda stored: stored.number,
        )
        every = self._rollouts.values()
        # The file may hold marks of other rollouts, too.
        seen = {one.mark.episode_id for one in mine if one.mark.presentation != REPEAT}
        seen &= {one.episode_id for one in every}
        given = by_people(stored.mark for stored in latest)
        raters = {
            episode_id: sum(one.presentation == FIRST for one in marks)
            for episode_id, marks in given.items()
        }
        waiting = [
            one
            for one in every
            if one.episode_id not in seen
            and raters.get(one.episode_id, 0) < self._raters_per_rollout
        ]
        tied = [
            one
            for one in every
            if one.episode_id not in seen and self._decides(rater, given.get(one.episode_id, ()))
        ]
        num_open = len(waiting) + len(tied)
        repeated = self._repeat(rater, mine, seen)
        if repeated is not None:
            return Assignment(repeated, REPEAT, len(seen), num_open)
        if not num_open:
            return None
        chosen = min(
            waiting or tied,
            key=lambda one: (raters.get(one.episode_id, 0), _order(rater, one.episode_id)),
        )
        return Assignment(chosen, FIRST if waiting else DECIDING, len(seen), num_open)

    def check(self, mark: Mark) -> None:
        """Refuse a mark by which a rater would count twice, or decide what is not tied.

        Raises ConflictError if its presentation is not that of the rater's assignment.
        """
        latest = (stored.mark for stored in self._marks.latest())
        given = [one for one in latest if one.episode_id == mark.episode_id]
        first = [one for one in given if (one.presentation, one.kind) == (FIRST, "human")]
        deciders = {one.rater for one in given if one.presentation == DECIDING}
        if (
            not self._decides(mark.rater, first)
            if mark.presentation == DECIDING
            else mark.presentation == FIRST and mark.rater in deciders
        ):
            raise ConflictError(
                f"rollout {token_of(mark.episode_id)!r}: got presentation {mark.presentation}, but "
                f"{DECIDING} decides where other raters are complete and tied, and {FIRST} is not "
                "for whoever did; ask for the next rollout and use its presentation"
            )

    def _decides(self, rater: str, marks: Sequence[Mark]) -> bool:
        """Whether a rollout's raters are complete and tied, and the rater is none of them."""
        num_first = sum(one.presentation == FIRST for one in marks)
        is_new = rater not in {one.rater for one in marks}
        return is_new and num_first >= self._raters_per_rollout and bool(vote(marks).tied)

    def _repeat(self, rater: str, mine: list[StoredMark], seen: set[str]) -> RatedRollout | None:
        repeats = {one.mark.episode_id for one in mine if one.mark.presentation == REPEAT} & seen
        if len(repeats) >= int(len(seen) * self._repeat_share):
            return None
        shown = (one.mark for one in mine[: max(0, len(mine) - REPEAT_GAP)])
        old = {mark.episode_id for mark in shown if mark.presentation == FIRST}
        fresh = [self._rollouts[token_of(name)] for name in (old & seen) - repeats]
        return min(fresh, key=lambda one: _order(rater, one.episode_id), default=None)


def _order(rater: str, episode_id: str) -> str:
    return hashlib.sha256(f"{rater}/{episode_id}".encode()).hexdigest()


def rated_rollouts(
    store: EpisodeStore, tasks: Collection[str], *, study: str | None = None
) -> list[RatedRollout]:
    """Rollouts of some tasks that have head images, of one study or all; takes of people are none.

    Raises InvalidInputError if there is nothing to rate.
    """
    found = []
    for episode_id in store.list():
        episode = store.open(episode_id)
        about = episode.attributes
        is_wanted = _is_rated(about) if study is None else study in studies_of(about)
        if is_wanted and about.task in tasks and HEAD_CAMERA in episode.streams:
            found.append(
                RatedRollout(
                    token_of(episode_id),
                    episode_id,
                    about.task,
                    about.instruction,
                    episode.num_steps,
                    about.model_rate_hz,
                )
            )
    if not found:
        of_study = "" if study is None else f" of the study {study!r}"
        raise InvalidInputError(
            f"store {store.root}: has no episode of {', '.join(sorted(tasks))} that is a "
            f"rollout{of_study} with the stream {HEAD_CAMERA}, expected at least one; takes of "
            "operators are not rated"
        )
    return found


def _is_rated(about: EpisodeAttributes) -> bool:
    """Whether an episode is a rollout: of a study, of a world model, or of the twin by itself."""
    if is_rollout(about) or about.origin == "imagined":
        return True
    return about.origin == "twin" and about.operator is None


def studies_of(about: EpisodeAttributes) -> set[str]:
    """Names of the studies of which an episode is a rollout."""
    return {entry.id.partition(": ")[0] for entry in about.lineage if entry.kind == "rollout"}


def state_scores(
    store: EpisodeStore, rollouts: Iterable[RatedRollout], rubrics: Mapping[str, Rubric]
) -> dict[str, float]:
    """Ground-truth scores of the twin's rollouts, from their milestones, by episode id.

    Rollouts of other worlds, rubrics that the twin cannot judge, and takes without recorded
    milestones have none.
    """
    found = {}
    for rollout in rollouts:
        about, rubric = store.open(rollout.episode_id).attributes, rubrics[rollout.task]
        was_noted = about.event_times_s or (about.success is False and not is_rollout(about))
        if about.origin != "twin" or not was_noted:
            continue
        # The twin notes when a milestone was first reached, so every criterion counts as latched.
        names = (one.milestone for one in rubric.criteria if one.milestone is not None)
        reached = {name: float(name in about.event_times_s) for name in names}
        score = rubric.score_by_milestones(reached)
        if score is not None:
            found[rollout.episode_id] = score
    return found


class RolloutPictures:
    """JPEG pictures of single steps: the head image beside taxel maps of both hands."""

    def __init__(self, store: EpisodeStore) -> None:
        # The page requests the steps of one rollout after another. Only readers are cached:
        # decoded images of a long rollout would take hundreds of megabytes.
        self._opened = lru_cache(maxsize=16)(store.open)

    def step(self, episode_id: str, step: int) -> bytes:
        """JPEG of one step, or of the nearest one with an image; NotFoundError for no such step."""
        episode = self._opened(episode_id)
        if not 0 <= step < episode.num_steps:
            raise NotFoundError(
                f"step {step}: the rollout has the steps 0 … {episode.num_steps - 1}"
            )
        window = episode.window(step, 1, cameras=(HEAD_CAMERA,))
        return encode_jpeg(
            side_by_side(
                window.images[HEAD_CAMERA][0], window.tactile_kpa[0], window.tactile_layout
            )
        )


def side_by_side(
    image: UInt8[np.ndarray, "h w 3"],
    tactile_kpa: Float32[np.ndarray, "2 taxels"],
    layout: TactileLayout = DEXTOUCH_V1,
) -> UInt8[np.ndarray, "height width 3"]:
    """The image, enlarged, beside the taxel maps of the left and the right hand."""
    height, width = image.shape[:2]
    size = (round(width * IMAGE_HEIGHT_PX / height), IMAGE_HEIGHT_PX)
    shown = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)
    touch = Image.fromarray(hands_image(tactile_kpa, cell_px=8, layout=layout))
    scale = min(IMAGE_HEIGHT_PX / touch.height, size[0] / touch.width)
    touch = touch.resize((round(touch.width * scale), round(touch.height * scale)))
    canvas = Image.new("RGB", (size[0] + touch.width + 8, IMAGE_HEIGHT_PX), (_BACKGROUND,) * 3)
    canvas.paste(shown, (0, 0))
    canvas.paste(touch, (size[0] + 8, (IMAGE_HEIGHT_PX - touch.height) // 2), touch)
    return np.asarray(canvas)
