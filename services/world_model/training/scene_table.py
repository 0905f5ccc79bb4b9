"""Tensors of whole episodes for training start readers and recurrent cores."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, Float64, Int64, Shaped, UInt8
from torch import Tensor

from dextouch.episodes import EpisodeGrid, ObjectTrack
from dextouch.errors import InvalidInputError
from dextouch.schemas import MAX_OBJECTS
from dextouch.tactile.layout import TactileLayout
from services.world_model.dynamics.features import (
    FREE_KPA,
    MAX_DISTANCE_M,
    SAMPLE_OFFSETS,
    SIZE_RANGE,
    STEPS_PER_LATENT,
    Commands,
    DynamicsConfig,
    HandMotion,
    ObjectPoses,
    hand_motion,
    instruction_features,
    objects_from_poses,
)
from services.world_model.dynamics.model import by_pad
from services.world_model.dynamics.start_reader import FirstStep
from services.world_model.dynamics.tensor_trees import by_name, chosen, mapped, stacked
from services.world_model.rendering.rasters import SceneStates
from services.world_model.rendering.training import SceneClip

# Objects that never move farther than this are fixed; measured ones by more than their errors.
_MOVED_M = 2e-3
MEASURED_ERROR_M = 5e-3
_MEASURED_MOVED_M = 4 * MEASURED_ERROR_M
# Touch of a hand of which less is measured says too little; alignment refuses such gloves, too.
LEAST_MEASURED = 0.5


@dataclass(frozen=True)
class HandTable:
    """Hands at every step of every episode, in the world."""

    points_m: Float32[Tensor, "episodes steps 2 12 3"]
    axes: Float32[Tensor, "episodes steps 2 6"]
    joints_rad: Float32[Tensor, "episodes steps 2 20"]

    @classmethod
    def of(cls, motions: Sequence[HandMotion]) -> "HandTable":
        """Stack motions of one length."""
        parts = ([getattr(one, part.name) for one in motions] for part in fields(cls))
        return cls(*(torch.from_numpy(np.stack(part)) for part in parts))


@dataclass(frozen=True)
class SceneTable:
    """Episodes on the model grid; shorter ones are filled up by their last step.

    `length` is the number of an episode's own steps, of which nothing measured the actions of those
    `interpolated`. The poses of objects are `objects_known` at a step; `measured_objects` marks
    episodes whose poses have the errors of a measurement, `touched` those of tasks of which some
    have poses from touch, `labelled` those whose poses are trained on; `placed_sd_m` is the
    standard deviation of positions from clicks or touch, else 0. `images` are those of the
    `image_steps`, where `shown`; `in_contact` marks pads. Taxels that are not `measured_taxels`
    have the pressure of the nearest one of their pad that is, or none; hands that are not `felt` at
    a step, for want of a sample or of half of their taxels, count in no loss. `sent` are the hands
    as `commanded`, elsewhere measured ones. `human` marks episodes of people, and `human_share` is
    their share in what is drawn, NaN if it follows from their number. `boxes_m` are the usual boxes
    of each task's objects in their frames (middle, half sizes), and `size` factors of their width
    and height. `instruction` are the features of each episode's sentence.
    """

    sent: HandTable
    measured: HandTable
    commanded: Bool[Tensor, " episodes"]
    Ts_world_camera: Float32[Tensor, "episodes steps 4 4"]
    objects: ObjectPoses
    tactile_kpa: Float16[Tensor, "episodes steps 2 taxels"]
    pads_kpa: Float32[Tensor, "episodes steps 12"]
    in_contact: Bool[Tensor, "episodes steps 12"]
    felt: Bool[Tensor, "episodes steps 2"]
    measured_taxels: Bool[Tensor, "episodes 2 taxels"]
    images: UInt8[Tensor, "episodes images px px 3"]
    shown: Bool[Tensor, "episodes images"]
    image_steps: tuple[int, ...]
    K_head: Float32[Tensor, "episodes 3 3"]
    success: Float32[Tensor, " episodes"]
    task: Int64[Tensor, " episodes"]
    human: Bool[Tensor, " episodes"]
    human_share: Float32[Tensor, ""]
    labelled: Bool[Tensor, " episodes"]
    length: Int64[Tensor, " episodes"]
    interpolated: Bool[Tensor, "episodes steps"]
    objects_known: Bool[Tensor, "episodes steps objects"]
    measured_objects: Bool[Tensor, " episodes"]
    touched: Bool[Tensor, " episodes"]
    placed_sd_m: Float32[Tensor, "episodes objects"]
    size: Float32[Tensor, "episodes objects 2"]
    boxes_m: Float32[Tensor, "tasks objects 6"]
    instruction: Float32[Tensor, "episodes features"]

    def __len__(self) -> int:
        return len(self.success)

    @property
    def num_steps(self) -> int:
        """Steps of the longest episode, including the first one."""
        return self.tactile_kpa.shape[1]

    def movable(self) -> Float32[Tensor, "tasks objects"]:
        """1 for objects that move in some labelled episode or are known once, 0 for fixed ones."""
        known = self.objects_known
        position_m, far = self.objects.position_m, torch.tensor(torch.inf)
        highest = torch.where(known[..., None], position_m, -far).amax(1)
        lowest = torch.where(known[..., None], position_m, far).amin(1)
        way_m = (highest - lowest).norm(dim=-1)
        least_m = torch.where(self.measured_objects, _MEASURED_MOVED_M, _MOVED_M)[:, None]
        is_there = (self.objects.present > 0) | ~known
        moves = known.any(1) & (way_m > least_m) & is_there.all(1) & self.labelled[:, None]
        is_watched = (known.sum(1) > 1) & self.labelled[:, None]
        found = torch.zeros(self.boxes_m.shape[:2])
        for task in range(len(found)):
            rows = self.task == task
            found[task] = (moves[rows].any(0) | ~is_watched[rows].any(0)).float()
        return found

    def first_steps(
        self, rows: Int64[Tensor, " batch"], steps: Int64[Tensor, " batch"]
    ) -> FirstStep:
        """Start reader inputs at steps that have an image."""
        places = torch.tensor([self.image_steps.index(int(step)) for step in steps])
        return FirstStep(
            self.images[rows, places],
            self.K_head[rows],
            self.Ts_world_camera[rows, steps],
            self.measured.points_m[rows, steps],
            self.pads_kpa[rows, steps],
            self.task[rows],
        )

    def objects_at(self, rows: Tensor, steps: Tensor | int) -> ObjectPoses:
        """True objects at one step of each episode."""
        return mapped(self.objects, lambda values: values[rows, steps])

    def drawn(
        self, able: Int64[Tensor, " rows"], count: int, generator: torch.Generator
    ) -> Int64[Tensor, " count"]:
        """Random episodes of some, maybe repeated; a share of them human if there are both."""
        is_human, share = self.human[able], self.human_share
        num_human = is_human.sum()
        if bool(share.isnan()) or not 0 < int(num_human) < len(able):
            return able[torch.randint(len(able), (count,), generator=generator)]
        of_each = torch.where(is_human, share / num_human, (1 - share) / (len(able) - num_human))
        return able[torch.multinomial(of_each, count, replacement=True, generator=generator)]

    def knows_all(self, step: int) -> Bool[Tensor, " episodes"]:
        """Episodes in which the poses of all objects are known at a step."""
        return self.objects_known[:, step].all(-1)

    def starts_at(self, step: int) -> Int64[Tensor, " rows"]:
        """Episodes with an image of `step` and a latent step after it."""
        shown = self.shown[:, self.image_steps.index(step)]
        fits = (self.length > step + STEPS_PER_LATENT) & ~self.interpolated[:, step]
        return torch.nonzero(shown & fits)[:, 0]

    def within(self, rows: Tensor, start: int) -> Bool[Tensor, "batch latents"]:
        """Latent steps after `start` that lie within an episode."""
        ends = torch.arange(start + STEPS_PER_LATENT, self.num_steps, STEPS_PER_LATENT)
        return ends < self.length[rows, None]

    def measured_within(self, rows: Tensor, start: int) -> Bool[Tensor, "batch latents"]:
        """Those `within` without an interpolated step, which losses count."""
        given = self.interpolated[rows][:, self.steps_after(start)].any(-1)
        return self.within(rows, start) & ~given

    def commands(self, rows: Tensor, start: int, use_measured: Bool[Tensor, " batch"]) -> Commands:
        """Measured hands at `start`, then the sent (or measured) ones until the end."""
        latents = torch.arange(start, self.num_steps - 1, STEPS_PER_LATENT)
        samples = latents[:, None] + torch.tensor(SAMPLE_OFFSETS)
        ends = samples[:, -1]

        def taken(name: str, steps: Tensor) -> Tensor:
            sent: Tensor = getattr(self.sent, name)[rows][:, steps]
            return chosen(use_measured, getattr(self.measured, name)[rows][:, steps], sent)

        here = self.measured
        holding = here.points_m[rows, start][:, None, None]
        holding = holding.expand(-1, 1, len(SAMPLE_OFFSETS), -1, -1, -1)
        return Commands(
            torch.cat([holding, taken("points_m", samples)], dim=1),
            torch.cat([here.axes[rows, start][:, None], taken("axes", ends)], dim=1),
            torch.cat([here.joints_rad[rows, start][:, None], taken("joints_rad", ends)], dim=1),
        )

    def steps_after(self, start: int) -> Int64[Tensor, "latents 4"]:
        """The four model steps of every latent after `start`."""
        latents = torch.arange(start, self.num_steps - 1, STEPS_PER_LATENT)
        return latents[:, None] + torch.arange(1, STEPS_PER_LATENT + 1)

    def tensors(self) -> dict[str, Tensor]:
        """All data as named tensors, to share with other processes through a file."""
        flat = {"image_steps": torch.tensor(self.image_steps)}
        for field in fields(self):
            if field.name != "image_steps":
                flat |= by_name(getattr(self, field.name), field.name)
        return {name: value.contiguous() for name, value in flat.items()}

    @classmethod
    def from_tensors(cls, flat: dict[str, Tensor]) -> "SceneTable":
        """Inverse of `tensors`."""
        parts: dict[str, Any] = {name: part for name, part in flat.items() if "." not in name}
        for name, kind in (("sent", HandTable), ("measured", HandTable), ("objects", ObjectPoses)):
            inner = {
                key.partition(".")[2]: one
                for key, one in flat.items()
                if key.startswith(f"{name}.")
            }
            parts[name] = kind(**inner)
        return cls(**{**parts, "image_steps": tuple(flat["image_steps"].tolist())})


def vocabulary(episodes: Sequence[EpisodeGrid]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Tasks in alphabetical order with the number of objects of each, the same in all episodes.

    Raises:
        InvalidInputError: no episodes, or a task whose episodes differ in their objects.
    """
    names: dict[str, set[tuple[str, ...]]] = {}
    for episode in episodes:
        names.setdefault(episode.task, set()).add(episode.object_names)
    uneven = {task: sorted(found) for task, found in names.items() if len(found) > 1}
    many = [name for name, (objects, *_) in names.items() if len(objects) > MAX_OBJECTS]
    if many:
        raise InvalidInputError(
            f"training episodes: tasks {many} have more objects than {MAX_OBJECTS}, the slots of "
            "the model; list those that matter to the outcome"
        )
    if not names or uneven:
        raise InvalidInputError(
            f"training episodes: got {len(episodes)} episodes, tasks with several lists of "
            f"objects {uneven}; expected at least one episode and one list for every task"
        )
    tasks = tuple(sorted(names))
    return tasks, tuple(len(*names[task]) for task in tasks)


def scene_table(
    episodes: Sequence[EpisodeGrid],
    config: DynamicsConfig,
    *,
    labelled: Sequence[bool] = (),
    human_share: float | None = None,
) -> SceneTable:
    """Build the tensors of episodes; what is left over of a latent step at an end is cut off.

    `labelled` says of each whether its object poses are trained on; by default all.

    Raises:
        InvalidInputError: no image of the first step, none later that all episodes have, too short
            an episode, or a task or image size that is not in the configuration.
    """
    tracks = _checked_tracks(episodes, config)
    lengths = [_whole(episode) for episode in episodes]
    num_steps, steps = max(lengths), _image_steps(episodes, lengths)
    sent, measured = [], []
    for one in episodes:
        measured.append(hand_motion(_filled(one.measured, one, num_steps), one.anchor))
        sent.append(hand_motion(_filled(one.sent, one, num_steps), one.anchor))
    layout, (tactile, felt) = config.tactile_layout, _touch(episodes, num_steps)
    tracked = list(zip(episodes, tracks, strict=True))
    objects = [objects_from_poses(_filled(track.poses, e, num_steps)) for e, track in tracked]
    known = np.stack([_known(e, track, num_steps) for e, track in tracked])
    sds_m = [np.pad(track.sd_m, (0, MAX_OBJECTS - len(track.sd_m))) for track in tracks]
    boxes_m = usual_boxes_m(episodes)
    touched_tasks = {one.task for one, track in tracked if "touch" in track.sources}
    return SceneTable(
        sent=HandTable.of(sent),
        measured=HandTable.of(measured),
        commanded=torch.tensor([e.action_kind == "commanded" for e in episodes]),
        Ts_world_camera=torch.from_numpy(np.stack([m.Ts_world_camera for m in measured])).float(),
        objects=stacked(objects),
        tactile_kpa=torch.from_numpy(tactile),
        pads_kpa=torch.from_numpy(by_pad(tactile.astype(np.float32), np.mean, layout)),
        in_contact=torch.from_numpy(by_pad(tactile, np.max, layout) >= FREE_KPA),
        felt=torch.from_numpy(felt),
        measured_taxels=torch.from_numpy(np.stack([e.measured_taxels for e in episodes])),
        images=torch.from_numpy(np.stack([_images(episode, steps) for episode in episodes])),
        shown=torch.from_numpy(np.stack([np.isin(steps, e.image_steps) for e in episodes])),
        image_steps=tuple(steps),
        K_head=torch.from_numpy(np.stack([e.K_head for e in episodes]).astype(np.float32)),
        success=torch.tensor([float(episode.success) for episode in episodes]),
        task=torch.tensor([config.tasks.index(episode.task) for episode in episodes]),
        human=torch.tensor([episode.domain == "human" for episode in episodes]),
        human_share=torch.tensor(torch.nan if human_share is None else human_share),
        labelled=torch.tensor(list(labelled) or [True] * len(episodes)),
        length=torch.tensor(lengths),
        interpolated=torch.from_numpy(
            np.stack([_filled(e.interpolated, e, num_steps) for e in episodes])
        ),
        objects_known=torch.from_numpy(known),
        measured_objects=torch.tensor([track.is_measured for track in tracks]),
        touched=torch.tensor([episode.task in touched_tasks for episode in episodes]),
        placed_sd_m=torch.from_numpy(np.stack(sds_m)).float(),
        size=torch.from_numpy(np.stack([_size(e, boxes_m[e.task]) for e in episodes])),
        boxes_m=_padded(boxes_m, config),
        instruction=instruction_features([e.about.instruction for e in episodes], config),
    )


def _whole(episode: EpisodeGrid) -> int:
    """Steps of an episode up to the end of its last whole latent step."""
    return len(episode) - (len(episode) - 1) % STEPS_PER_LATENT


def _filled(
    values: Shaped[np.ndarray, "steps ..."], episode: EpisodeGrid, num_steps: int
) -> Shaped[np.ndarray, "filled ..."]:
    """Values of an episode's steps, the last one repeated up to the length of the table."""
    return values[np.arange(num_steps).clip(max=_whole(episode) - 1)]


def _touch(
    episodes: Sequence[EpisodeGrid], num_steps: int
) -> tuple[Float16[np.ndarray, "episodes steps 2 taxels"], Bool[np.ndarray, "episodes steps 2"]]:
    """Pressures (kPa) at every step, those of unmeasured taxels filled, and which hands count."""
    tactile, felt = [], []
    for one in episodes:
        touch_kpa, is_sampled = filled_touch(one)
        measured = one.measured_taxels
        tactile.append(_filled(touch_kpa.astype(np.float16), one, num_steps))
        is_felt = is_sampled & (measured.mean(axis=-1) >= LEAST_MEASURED)
        felt.append(_filled(is_felt, one, num_steps))
    return np.stack(tactile), np.stack(felt)


def filled_touch(
    episode: EpisodeGrid,
) -> tuple[Float32[np.ndarray, "steps 2 taxels"], Bool[np.ndarray, "steps 2"]]:
    """Pressures (kPa) of `filled_taxels`, and what was sampled."""
    touch_kpa, is_sampled = episode.touch()
    return filled_taxels(touch_kpa, episode.measured_taxels, episode.tactile_layout), is_sampled


def filled_taxels(
    touch_kpa: Float32[np.ndarray, "steps 2 taxels"],
    measured: Bool[np.ndarray, "2 taxels"],
    layout: TactileLayout,
) -> Float32[np.ndarray, "steps 2 taxels"]:
    """Pressures (kPa) with unmeasured taxels as the nearest measured one of their pad, or 0."""
    if measured.all():
        return touch_kpa
    nearest = np.stack([_nearest_measured(hand, layout) for hand in measured])
    is_known = np.take_along_axis(measured, nearest, axis=-1)
    return np.take_along_axis(touch_kpa, nearest[None], axis=-1) * is_known


def _nearest_measured(
    measured: Bool[np.ndarray, " taxels"], layout: TactileLayout
) -> Int64[np.ndarray, " taxels"]:
    """For each taxel the nearest measured one in rows and columns of its pad, or itself."""
    nearest = np.arange(layout.num_taxels)
    if measured.all():
        return nearest
    for pad in [pad for stack in layout.split(nearest) for pad in stack]:
        if measured[pad].any():
            cells, known = np.argwhere(np.ones(pad.shape)), np.argwhere(measured[pad])
            away = np.square(cells[:, None] - known).sum(axis=-1)
            nearest[pad.ravel()] = pad[tuple(known[away.argmin(axis=1)].T)]
    return nearest


def _known(
    episode: EpisodeGrid, track: ObjectTrack, num_steps: int
) -> Bool[np.ndarray, "steps slots"]:
    """Where poses are known: those of slots without an object always."""
    known = np.ones((num_steps, MAX_OBJECTS), dtype=np.bool_)
    count = track.known.shape[1]
    known[:, :count] = _filled(track.known, episode, num_steps)
    known[_whole(episode) :, :count] = False
    return known


def _image_steps(episodes: Sequence[EpisodeGrid], lengths: Sequence[int]) -> list[int]:
    """Latent steps with an image in at least half of the episodes that have them."""
    num_shown, num_long = np.zeros((2, max(lengths)), dtype=np.int64)
    for episode, length in zip(episodes, lengths, strict=True):
        own = episode.image_steps
        if not len(own) or own[0] != 0:
            raise InvalidInputError(
                f"episode {episode.episode_id}: has images of steps {own[:4].tolist()} …, expected "
                "step 0 among them; record it again"
            )
        num_shown[own[own < length]] += 1
        num_long[:length] += 1
    common = np.flatnonzero(2 * num_shown >= num_long.clip(1))
    steps = [step for step in common.tolist() if step % STEPS_PER_LATENT == 0]
    if len(steps) < 2:
        raise InvalidInputError(
            f"training episodes: at least half have images of steps {common[:4].tolist()} …, "
            f"expected step 0 and a later multiple of {STEPS_PER_LATENT}; record with --images "
            f"{STEPS_PER_LATENT} or a divisor of it"
        )
    return steps


def _images(episode: EpisodeGrid, steps: Sequence[int]) -> UInt8[np.ndarray, "shown px px 3"]:
    """Images of the given steps; of those that an episode lacks, the next one or the last."""
    places = np.searchsorted(episode.image_steps, steps)
    return episode.images(episode.image_steps[places.clip(max=len(episode.image_steps) - 1)])


def usual_boxes_m(episodes: Sequence[EpisodeGrid]) -> dict[str, Float64[np.ndarray, "objects 6"]]:
    """Boxes of each task's objects (middle, half sizes, in their frames), medians over episodes."""
    by_task: dict[str, list[np.ndarray]] = {episode.task: [] for episode in episodes}
    for episode in episodes:
        if len(episode.boxes_m):
            by_task[episode.task].append(episode.boxes_m)
    none = np.zeros((0, 6))
    return {task: np.median(b, axis=0) if b else none for task, b in by_task.items()}


def _size(
    episode: EpisodeGrid, usual_m: Float64[np.ndarray, "objects 6"]
) -> Float32[np.ndarray, "slots 2"]:
    """Width and height of an episode's objects relative to the usual ones; 1 in empty slots."""
    size = np.ones((MAX_OBJECTS, 2), dtype=np.float32)
    if len(episode.boxes_m):
        for column, part in enumerate((slice(3, 5), slice(5, 6))):
            factors = episode.boxes_m[:, part].mean(1) / usual_m[:, part].mean(1).clip(1e-6)
            size[: len(factors), column] = factors.clip(*SIZE_RANGE)
    return size


def _padded(
    boxes_m: Mapping[str, np.ndarray], config: DynamicsConfig
) -> Float32[Tensor, "tasks objects 6"]:
    boxes = torch.zeros(len(config.tasks), MAX_OBJECTS, 6)
    for task, known in boxes_m.items():
        boxes[config.tasks.index(task), : len(known)] = torch.from_numpy(known).float()
    return boxes


def _checked_tracks(episodes: Sequence[EpisodeGrid], config: DynamicsConfig) -> list[ObjectTrack]:
    if not episodes:
        raise InvalidInputError("training episodes: got none, expected at least one")
    size_px = (config.image_px, config.image_px)
    tracks = []
    for episode in episodes:
        track = episode.objects
        if track is None or episode.task not in config.tasks or track.poses.shape[1] > MAX_OBJECTS:
            raise InvalidInputError(
                f"episode {episode.episode_id}: task {episode.task!r} with "
                f"{'unknown' if track is None else track.poses.shape[1]} objects, expected one of "
                f"{config.tasks} with at most {MAX_OBJECTS}"
            )
        if _whole(episode) <= STEPS_PER_LATENT or episode.image_size_px != size_px:
            raise InvalidInputError(
                f"episode {episode.episode_id}: {len(episode)} steps with images of "
                f"{episode.image_size_px} px, expected more than {STEPS_PER_LATENT} steps and "
                f"images of {size_px} px"
            )
        tracks.append(track)
    return tracks


def scene_clips(episodes: Sequence[EpisodeGrid]) -> list[SceneClip]:
    """Clips of the images of which all objects are known, where an episode has two or more."""
    clips = []
    for one in episodes:
        if (track := one.objects) is None or not len(one.boxes_m):
            continue
        steps = one.image_steps[track.known[one.image_steps].all(axis=1)]
        if len(steps) < 2:
            continue
        poses = track.poses[steps].astype(np.float64)
        present = np.linalg.norm(poses[..., :3], axis=-1) <= MAX_DISTANCE_M
        states = SceneStates.of_actions(one.measured[steps], one.anchor, poses, present)
        clips.append(SceneClip(steps, one.images(steps), states, one.K_head, one.boxes_m))
    return clips
