"""Endings of rollouts, true and imagined: input and training data of success classifiers."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
import structlog
from jaxtyping import Bool, Float32, Float64, UInt8

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    Split,
    needs,
    object_track,
    scene_fraction,
    select_episodes,
)
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import invert, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import (
    MAX_OBJECTS,
    Observation,
    RolloutUncertainty,
    is_rollout,
    rollout_uncertainty,
)
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile.layout import DEXTOUCH_V1
from services.evaluation.matched_starts import start_digest
from services.networks.training_settings import USUAL_IMAGE_PX

logger = structlog.get_logger(__name__)

NUM_SEEN_STEPS: Final = 3  # chosen: 0.2 s, in which motion shows
# Share of an object's usual size. Start readers err by 4 to 7 % (`python -m benchmarks starts`).
UNUSUAL_SIZE: Final = 0.1
# Each training episode is cut at one early and one middle step, drawn by its scene. Early endings
# are failures, since nothing was done yet; in the middle only the milestones are known.
EARLY_ENDS: Final = (2, 8, 14)
MIDDLE_ENDS: Final = (32, 48, 64)
# Last step of the episodes that these steps belong to; in others they lie as far along.
_USUAL_END: Final = 80
# What an episode of a judge must have.
JUDGED: Final = (needs.EVERY_PART, needs.WHOLE, needs.OUTCOME, needs.longer_than(16), needs.IMAGES)
NUM_PAD_FEATURES = 24
_PAIRS: Final = tuple(combinations(range(MAX_OBJECTS), 2))
# Success is decided by millimetres within half a metre, so distances enter features of poses twice:
# linearly, and compressed by asinh.
_WIDE_M, _NEAR_M, _STILL_M, _STILL_RAD = 0.1, 0.01, 0.002, 0.05
_OF_OBJECT, _OF_PAIR = 17, 18
NUM_OBJECT_FEATURES: Final = MAX_OBJECTS * _OF_OBJECT + len(_PAIRS) * _OF_PAIR


def early_step(scene: str, last_step: int = _USUAL_END) -> int:
    """The step of `EARLY_ENDS`, or as far along, at which an episode of this scene is cut."""
    return _cut(EARLY_ENDS, scene_fraction(scene, salt="early "), last_step)


def middle_step(scene: str, last_step: int = _USUAL_END) -> int:
    """The step of `MIDDLE_ENDS`, or as far along, at which an episode of this scene is cut."""
    return _cut(MIDDLE_ENDS, scene_fraction(scene, salt="middle "), last_step)


def _cut(ends: tuple[int, ...], fraction: float, last_step: int) -> int:
    usual = ends[int(fraction * len(ends))]
    return max(NUM_SEEN_STEPS - 1, round(usual * last_step / _USUAL_END))


@dataclass(frozen=True)
class Ending:
    """The last three steps of a rollout: head images, taxels in kPa, and object poses.

    `object_poses` are T_world_object (x y z m, qw qx qy qz) of at most three objects, NaN for an
    unknown object; only imagined worlds provide them. `images` are None if they were not
    requested; images or object poses are required. `unreliable` is the reason why the world itself
    flags its prediction as uncertain, `success_probability` its own estimate of the outcome, and
    `size_deviation` how much the size of an object differs from the usual one; all are of the whole
    rollout.
    """

    images: UInt8[np.ndarray, "3 h w 3"] | None
    tactile_kpa: Float32[np.ndarray, "3 2 taxels"]
    task: str
    object_poses: Float32[np.ndarray, "3 objects 7"] | None = None
    imagined: bool = False
    unreliable: str | None = None
    success_probability: float | None = None
    size_deviation: float | None = None

    @property
    def shows_scene(self) -> bool:
        """Whether there are images or poses of objects, as judging needs."""
        return self.images is not None or self.object_poses is not None

    @property
    def has_unusual_sizes(self) -> bool:
        """Whether an object is clearly larger or smaller than usual, in the world's estimate."""
        return self.size_deviation is not None and self.size_deviation > UNUSUAL_SIZE

    @classmethod
    def of(
        cls,
        observation: Observation,
        task: str,
        *,
        imagined: bool,
        uncertainty: RolloutUncertainty | None = None,
    ) -> "Ending":
        """Ending shown by the last observation of a rollout.

        `uncertainty` is that of the whole rollout; None if it has no observation but this one.
        Raises InvalidInputError for fewer than three steps.
        """
        if len(observation) < NUM_SEEN_STEPS:
            raise InvalidInputError(
                f"ending: got {len(observation)} steps, expected at least {NUM_SEEN_STEPS}; send "
                "longer chunks and request all steps of the last one"
            )
        images = observation.images.get(HEAD_CAMERA)
        poses = observation.object_poses
        ending = cls(
            None if images is None else images[-NUM_SEEN_STEPS:],
            observation.tactile_kpa[-NUM_SEEN_STEPS:],
            task,
            None if poses is None else poses[-NUM_SEEN_STEPS:],
            imagined,
        )
        return ending.with_uncertainty(
            rollout_uncertainty([observation]) if uncertainty is None else uncertainty
        )

    def with_uncertainty(self, uncertainty: RolloutUncertainty) -> "Ending":
        """The ending with what the world says about the whole rollout."""
        return replace(
            self,
            unreliable=None
            if uncertainty.reason is None
            else f"at step {uncertainty.step}, {uncertainty.reason}",
            success_probability=uncertainty.success_probability,
            size_deviation=uncertainty.size_deviation,
        )


@dataclass(frozen=True)
class EndingEpisode:
    """One episode of known outcome with the endings used for training.

    `endings` holds the observations at some steps, the last one among them, if images or poses of
    objects were recorded there; `success` is the real
    outcome of these actions, also for an imagined episode. `event_times_s` is when each milestone
    was first reached, None where that is unknown.
    """

    episode_id: str
    task: str
    instruction: str
    scene: str
    success: bool
    start_digest: str
    last_step: int
    endings: Mapping[int, Ending]
    content_sha256: str
    event_times_s: Mapping[str, float] | None = None
    step_s: float = 1 / 15

    @property
    def imagined(self) -> bool:
        """Whether a world model imagined it."""
        return self.final.imagined

    @property
    def final(self) -> Ending:
        """The final ending."""
        return self.endings[self.last_step]

    def reached(self, milestones: Sequence[str], step: int) -> list[bool] | None:
        """Whether each milestone was reached by a step; None where that is unknown."""
        times = self.event_times_s
        if times is None:
            return None
        now_s = (step + 0.5) * self.step_s
        return [times.get(name, np.inf) <= now_s for name in milestones]


def read_ending_episode(reader: EpisodeReader, *, image_px: int = USUAL_IMAGE_PX) -> EndingEpisode:
    """Endings of one stored robot episode that has what is `JUDGED`.

    Only the steps shown are decoded; the middle square of larger images is scaled to `image_px`.
    Raises InvalidInputError if the outcome is unknown.
    """
    grid, about = EpisodeGrid(reader, image_px), reader.attributes
    last, touch_kpa = len(grid) - 1, grid.touch()[0]
    ends = (early_step(grid.scene, last), middle_step(grid.scene, last), last - 1, last)
    endings = {end: _read_ending(grid, touch_kpa, end) for end in ends}
    endings[last] = endings[last].with_uncertainty(RolloutUncertainty.from_quality(about.quality))
    endings = {end: ending for end, ending in endings.items() if ending.shows_scene}
    times = about.event_times_s
    # None noted in a true failure means none reached.
    is_known = times or not (about.success or about.origin == "imagined" or is_rollout(about))
    return EndingEpisode(
        about.episode_id,
        about.task,
        about.instruction,
        grid.scene,
        grid.success,
        start_digest(EpisodeGrid(reader).images([0])[0], touch_kpa[0]),
        last,
        endings,
        grid.content_sha256,
        times if is_known else None,
        1 / about.model_rate_hz,
    )


def _read_ending(
    grid: EpisodeGrid, touch_kpa: Float32[np.ndarray, "steps 2 taxels"], end: int
) -> Ending:
    steps = slice(end - NUM_SEEN_STEPS + 1, end + 1)
    return Ending(
        # Where these steps were not rendered, the nearest images are of others.
        grid.own_images(range(steps.start, steps.stop)),
        touch_kpa[steps].copy(),
        grid.task,
        _object_poses(grid.reader, grid.t_ref_ns[steps]),
        grid.about.origin == "imagined",
    )


def _object_poses(
    reader: EpisodeReader, t_ref_ns: np.ndarray
) -> Float32[np.ndarray, "3 objects 7"] | None:
    """Poses at these steps; NaN for objects that are not known at all of them."""
    track = object_track(reader, t_ref_ns)
    if track is None:
        return None
    poses = track.poses.copy()
    poses[:, ~np.all(track.known, axis=0)] = np.nan
    return poses


def read_ending_episodes(
    *stores: EpisodeStore,
    tasks: Sequence[str] = (),
    splits: Collection[Split] = (),
    image_px: int = USUAL_IMAGE_PX,
) -> list[EndingEpisode]:
    """Read true and imagined robot episodes of some stores that can be judged, with their endings.

    Raises as `select_episodes` and `read_ending_episode`.
    """
    readers = select_episodes(
        stores, domain="robot", tasks=tasks, splits=splits, origins=(), needs=JUDGED
    )
    episodes = [read_ending_episode(reader, image_px=image_px) for reader in readers]
    judged = [episode for episode in episodes if episode.last_step in episode.endings]
    if len(judged) < len(episodes):
        reason = "without images of their last steps or poses of their objects there"
        logger.warning("skipped_episodes", reason=reason, count=len(episodes) - len(judged))
    return judged


def milestones_of(episodes: Iterable[EndingEpisode]) -> dict[str, tuple[str, ...]]:
    """Milestones of every task, in the order in which they are usually reached."""
    times: dict[str, dict[str, list[float]]] = {}
    for item in episodes:
        for name, time_s in (item.event_times_s or {}).items():
            times.setdefault(item.task, {}).setdefault(name, []).append(time_s)
    return {
        task: tuple(sorted(known, key=lambda name: (float(np.median(known[name])), name)))
        for task, known in times.items()
    }


def pad_features(tactile_kpa: np.ndarray) -> Float32[np.ndarray, "*batch 24"]:
    """Mean and maximum of √kPa / 4 per hand and pad of pressures [..., 2, 320] of `dextouch_v1`.

    Small negative readings count as zero. Raises ShapeError for another shape, such as touch of
    another glove, and NonFiniteError for NaN or infinity.
    """
    taxels = np.asarray(tactile_kpa, dtype=np.float32)
    layout = DEXTOUCH_V1
    if taxels.shape[-2:] != (2, layout.num_taxels):
        raise ShapeError(
            f"tactile: got shape {taxels.shape}, expected [..., 2, {layout.num_taxels}] of layout "
            f"{layout.name!r}, the only one that success classifiers and cloned policies support"
        )
    if not np.isfinite(taxels).all():
        raise NonFiniteError("tactile: NaN or infinite pressure; expected finite kPa")
    roots = np.sqrt(np.maximum(taxels, 0.0)) / 4
    features = np.concatenate([layout.by_part(roots, of) for of in (np.mean, np.max)], axis=-1)
    return features.reshape(*features.shape[:-2], NUM_PAD_FEATURES)


def object_features(object_poses: np.ndarray) -> Float32[np.ndarray, "105"]:
    """Features of the poses T_world_object [steps, objects ≤ 3, 7] (x y z m, qw qx qy qz).

    The last step is the current one. An object with a non-finite number or a zero quaternion counts
    as absent; it and its pairs give zeros. Raises ShapeError for other shapes, or more objects.
    """
    poses = np.asarray(object_poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[2] != 7 or not 0 < poses.shape[1] <= MAX_OBJECTS:
        raise ShapeError(
            f"object poses: got shape {poses.shape}, expected [steps, 1 … {MAX_OBJECTS}, 7]"
        )
    present = known_objects(poses)
    safe = np.where(present[:, None], poses, np.array([0.0, 0, 0, 1, 0, 0, 0]))
    T = transform_from_pose(safe)
    parts = []
    for slot in range(MAX_OBJECTS):
        there = slot < len(present) and bool(present[slot])
        parts.append(_of_object(T[:, slot]) if there else np.zeros(_OF_OBJECT))
    for first, second in _PAIRS:
        there = second < len(present) and bool(present[first] and present[second])
        pair = _of_pair(T[-1, first], T[-1, second]) if there else np.zeros(_OF_PAIR)
        parts.append(pair)
    return np.concatenate(parts).astype(np.float32)


def known_objects(object_poses: np.ndarray) -> Bool[np.ndarray, " objects"]:
    """Mask of objects in poses [steps, objects, 7] that have a pose at every step."""
    finite = np.isfinite(object_poses).all(axis=(0, 2))
    length = np.linalg.norm(np.nan_to_num(object_poses[..., 3:]), axis=-1)
    return np.asarray(finite & (length > 1e-6).all(axis=0))


def _of_object(Ts_world_object: np.ndarray) -> Float64[np.ndarray, "17"]:
    T = Ts_world_object[-1]
    moved_m = T[:3, 3] - Ts_world_object[0, :3, 3]
    turned_rad = rotation_angle(T[:3, :3] @ Ts_world_object[0, :3, :3].T)
    return np.concatenate(
        [
            [1.0, np.arcsinh(T[2, 3] / _NEAR_M)],
            T[:3, 3] / _WIDE_M,
            T[:3, :3].ravel(),
            [
                np.arcsinh(np.linalg.norm(moved_m) / _STILL_M),
                np.arcsinh(moved_m[2] / _STILL_M),
                np.arcsinh(float(turned_rad) / _STILL_RAD),
            ],
        ]
    )


def _of_pair(T_world_a: np.ndarray, T_world_b: np.ndarray) -> Float64[np.ndarray, "18"]:
    """Second object relative to the first, and their horizontal and vertical distance."""
    T_a_b = invert(T_world_a) @ T_world_b
    offset_m = T_world_b[:3, 3] - T_world_a[:3, 3]
    return np.concatenate(
        [
            [1.0],
            T_a_b[:3, 3] / _WIDE_M,
            np.arcsinh(T_a_b[:3, 3] / _NEAR_M),
            T_a_b[:3, :3].ravel(),
            [np.arcsinh(np.linalg.norm(offset_m[:2]) / _NEAR_M), np.arcsinh(offset_m[2] / _NEAR_M)],
        ]
    )
