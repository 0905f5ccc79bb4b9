"""Episodes that the paper's form is trained on, in memory or on disk, and their windows."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any, TypeAlias, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    Split,
    needs,
    select_episodes,
)
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses, poses_from_actions, reanchor
from dextouch.schemas import ActionKind, Domain
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile.layout import DEXTOUCH_V1, NUM_TAXELS, TactileLayout
from services.world_model.network.inputs import (
    ObjectsAtStart,
    PastImages,
    PastRule,
    PredictionRequest,
)
from services.world_model.training.scene_table import LEAST_MEASURED, filled_taxels

# Open readers per process; each holds an episode's timestamps and actions.
MAX_OPEN_READERS = 512
# Chosen: half of the windows of episodes that have commanded actions have these, since policies
# send them, and of those a third is anchored like the later chunks of a rollout.
_COMMANDED_SHARE, _CHAINED_SHARE = 0.5, 0.3


@dataclass(frozen=True)
class WindowPosition:
    """Position of a window: steps start … start + num_steps − 1 of an episode.

    `from_command` anchors commanded actions at the first step's *commanded* pose. `past` says which
    images before it are remembered, and the further views at the indices `hidden` are left out.
    """

    episode_index: int
    start: int
    num_steps: int
    action_kind: ActionKind = "measured"
    from_command: bool = False
    past: PastRule | None = None
    hidden: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Window:
    """One slice of an episode: the request to the model and the true future.

    Taxels that are not `measured_taxels` have the pressure of the nearest one of their pad that is,
    or none; hands of which less than half is measured are not valid.
    """

    request: PredictionRequest
    images: UInt8[np.ndarray, "time h w 3"]
    tactile_kpa: Float32[np.ndarray, "time 2 taxels"]
    tactile_valid: Bool[np.ndarray, "time 2"]
    measured_taxels: Bool[np.ndarray, "2 taxels"]
    further: UInt8[np.ndarray, "views time h w 3"] | None = None


Steps: TypeAlias = Int64[np.ndarray, " n"]


@dataclass(frozen=True)
class _Span:
    """What a window takes from an episode beside images.

    `actions` from the step `first` on are relative to `anchor`, the measured poses of that step.
    """

    instruction: str
    first: int
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    actions: dict[ActionKind, Float64[np.ndarray, "steps 67"]]
    touch: tuple[np.ndarray, np.ndarray, np.ndarray]
    objects: ObjectsAtStart | None


@dataclass(frozen=True, kw_only=True)
class _Episode(ABC):
    """What is known of an episode that windows are cut from, in memory or on disk."""

    episode_id: str
    task: str
    scene: str
    model_rate_hz: float
    content_sha256: str
    domain: Domain = "robot"
    interpolated: Bool[np.ndarray, " steps"] | None = None
    tactile_layout: TactileLayout = DEXTOUCH_V1

    @property
    @abstractmethod
    def missing(self) -> tuple[bool, ...]:
        """Which further views the episode lacks."""

    @abstractmethod
    def _span(self, place: WindowPosition, first: int) -> _Span:
        """What the window takes, with actions from a step on, or from an earlier one."""

    @abstractmethod
    def _images_at(self, steps: Steps, view: int) -> UInt8[np.ndarray, "n h w 3"] | None:
        """Images of the head (0) or of a further view; None of one that is missing."""

    def cut(self, place: WindowPosition) -> Window:
        """Cut the window at a place in this episode, and re-anchor its actions to its first step.

        Commanded actions `from_command` are anchored as those of a served rollout after its first
        chunk, since it measures no pose.

        Raises:
            InvalidInputError, UnknownNameError, CorruptDataError: as `EpisodeReader.window`.
        """
        steps = np.arange(place.start, place.start + place.num_steps)
        kept = steps[:0] if place.past is None else place.past.steps(place.start)
        span = self._span(place, int(min([*kept[:1], place.start])))
        known = span.actions[place.action_kind]
        origin_kind = place.action_kind if place.from_command else "measured"
        origin = span.actions[origin_kind][place.start - span.first]
        actions = reanchor(known[steps - span.first], 0, anchor_action=origin)

        def views_at(chosen: Steps) -> list[np.ndarray | None]:
            views = range(len(self.missing))
            shown = [None if i in place.hidden else self._images_at(chosen, 1 + i) for i in views]
            return [self._images_at(chosen, 0), *shown]

        past = None
        if place.past is not None and len(kept):
            poses = reanchor(known[kept - span.first], 0, anchor_action=origin)
            rows = place.past.chosen(poses, actions)
            images = np.stack(_filled(views_at(kept[rows])), axis=1)
            past = PastImages(poses[rows], place.start - kept[rows], images)
        views = views_at(steps)
        head, *further = _filled(views)
        felt_kpa, valid, measured = span.touch
        touch_kpa = filled_taxels(felt_kpa, measured, self.tactile_layout)
        valid = valid & (measured.mean(axis=-1) >= LEAST_MEASURED)
        request = PredictionRequest(
            first_image=head[0],
            first_tactile_kpa=touch_kpa[0],
            actions=actions,
            action_kind=place.action_kind,
            instruction=span.instruction,
            anchor=poses_from_actions(origin[None], span.anchor).anchor(0),
            K_head=span.K_head,
            objects=span.objects,
            further_images=tuple(None if one is None else one[0] for one in views[1:]),
            past=past,
        )
        more = np.stack(further) if further else None
        return Window(request, head, touch_kpa, valid, measured, more)


def _filled(views: Sequence[np.ndarray | None]) -> list[UInt8[np.ndarray, "n h w 3"]]:
    """Images of all views, black where one is missing."""
    like = next(one for one in views if one is not None)
    return [np.zeros_like(like) if one is None else one for one in views]


@dataclass(frozen=True, kw_only=True)
class EpisodeArrays(_Episode):
    """One episode on the model grid; actions are relative to its step 0, missing views None."""

    instruction: str
    images: UInt8[np.ndarray, "steps h w 3"]
    tactile_kpa: Float32[np.ndarray, "steps 2 taxels"]
    tactile_valid: Bool[np.ndarray, "steps 2"]
    actions: dict[ActionKind, Float64[np.ndarray, "steps 67"]]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    object_poses: Float32[np.ndarray, "steps objects 7"] | None = None
    boxes_m: Float64[np.ndarray, "objects 6"] | None = None
    measured_taxels: Bool[np.ndarray, "2 taxels"] = field(
        default_factory=lambda: np.ones((2, NUM_TAXELS), dtype=np.bool_)
    )
    further: tuple[UInt8[np.ndarray, "steps h w 3"] | None, ...] = ()

    def __len__(self) -> int:
        return len(self.tactile_kpa)

    @property
    def missing(self) -> tuple[bool, ...]:
        """Which further views it lacks."""
        return tuple(images is None for images in self.further)

    def objects_at(self, step: int) -> ObjectsAtStart | None:
        """Objects at a step, if their poses and boxes are known."""
        if self.object_poses is None or self.boxes_m is None:
            return None
        return ObjectsAtStart(self.object_poses[step].astype(np.float64), self.boxes_m)

    @property
    def action_kinds(self) -> tuple[ActionKind, ...]:
        """Available kinds of actions."""
        return tuple(self.actions)

    def fingerprint(self) -> str:
        """SHA-256 of observations and actions, by which checkpoints list training episodes."""
        digest = hashlib.sha256()
        digest.update(np.ascontiguousarray(self.images).tobytes())
        digest.update(np.ascontiguousarray(self.tactile_kpa, dtype="<f4").tobytes())
        for kind in sorted(self.actions):
            digest.update(kind.encode())
            # Rounded to a micrometre: re-anchoring changes the last bits of poses. Adding zero
            # turns minus zero into zero.
            rounded = self.actions[kind].round(6) + 0.0
            digest.update(np.ascontiguousarray(rounded, dtype="<f8").tobytes())
        return digest.hexdigest()

    def _images_at(self, steps: Steps, view: int) -> UInt8[np.ndarray, "n h w 3"] | None:
        images = (self.images, *self.further)[view]
        return None if images is None else images[steps]

    def _span(self, place: WindowPosition, _: int) -> _Span:
        steps = slice(place.start, place.start + place.num_steps)
        touch = self.tactile_kpa[steps], self.tactile_valid[steps], self.measured_taxels
        objects = self.objects_at(place.start)
        return _Span(self.instruction, 0, self.anchor, self.K_head, self.actions, touch, objects)


@dataclass(frozen=True)
class WindowBatch:
    """Batch of windows of one length; `further` are the images of further views, if any."""

    requests: list[PredictionRequest]
    images: UInt8[Tensor, "batch time px px 3"]
    tactile_kpa: Float32[Tensor, "batch time 2 taxels"]
    tactile_valid: Bool[Tensor, "batch time 2"]
    measured_taxels: Bool[Tensor, "batch 2 taxels"]
    further: UInt8[Tensor, "batch views time px px 3"] | None = None


def stack_windows(windows: Sequence[Window]) -> WindowBatch:
    """Windows of one length as a batch."""
    further = [window.further for window in windows if window.further is not None]
    return WindowBatch(
        [window.request for window in windows],
        torch.from_numpy(np.stack([window.images for window in windows])),
        torch.from_numpy(np.stack([window.tactile_kpa for window in windows])),
        torch.from_numpy(np.stack([window.tactile_valid for window in windows])),
        torch.from_numpy(np.stack([window.measured_taxels for window in windows])),
        torch.from_numpy(np.stack(further)) if further else None,
    )


def read_episode(
    reader: EpisodeReader, *, image_px: int | None = None, further_views: Sequence[str] = ()
) -> EpisodeArrays:
    """Read a whole episode, the middle square of larger images scaled to `image_px`.

    Further views are missing without an image of nearly every step.

    Raises:
        InvalidInputError: the image of a step is missing.
        UnknownNameError: an episode without the head camera.
    """
    reader.require_images(HEAD_CAMERA)
    grid, about = EpisodeGrid(reader, image_px), reader.attributes
    actions: dict[ActionKind, Float64[np.ndarray, "steps 67"]] = {"measured": grid.measured}
    if grid.action_kind == "commanded":
        actions["commanded"] = reader.actions(0, len(grid), kind="commanded")
    tactile_kpa, tactile_valid = grid.touch()
    poses, boxes_m = grid.boxed_objects(grid.t_ref_ns) or (None, None)
    return EpisodeArrays(
        episode_id=about.episode_id,
        task=about.task,
        instruction=about.instruction,
        scene=grid.scene,
        images=grid.images(range(len(grid))),
        further=tuple(
            grid.images(range(len(grid)), view)
            if view in reader.streams and reader.has_every_image(view)
            else None
            for view in further_views
        ),
        tactile_kpa=tactile_kpa,
        tactile_valid=tactile_valid,
        actions=actions,
        anchor=grid.anchor,
        K_head=grid.K_head,
        model_rate_hz=about.model_rate_hz,
        content_sha256=grid.content_sha256,
        domain=about.domain,
        object_poses=poses,
        boxes_m=boxes_m,
        interpolated=grid.interpolated if grid.interpolated.any() else None,
        measured_taxels=grid.measured_taxels,
        tactile_layout=grid.tactile_layout,
    )


@lru_cache(maxsize=MAX_OPEN_READERS)
def _reader(url: str, episode_id: str) -> EpisodeReader:
    return EpisodeStore(url).open(episode_id)


@dataclass(frozen=True, kw_only=True)
class StoredEpisode(_Episode):
    """One episode that stays on disk; created by `index_episodes`."""

    url: str
    num_steps: int
    action_kinds: tuple[ActionKind, ...]
    print_sha256: str
    image_px: int | None = None
    missing: tuple[bool, ...] = ()
    further_views: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self.num_steps

    def fingerprint(self) -> str:
        """That of its arrays when it was indexed."""
        return self.print_sha256

    def load(self) -> EpisodeArrays:
        """Load the whole episode."""
        return read_episode(
            _reader(self.url, self.episode_id),
            image_px=self.image_px,
            further_views=self.further_views,
        )

    def _grid(self) -> EpisodeGrid:
        return EpisodeGrid(_reader(self.url, self.episode_id), self.image_px)

    def _images_at(self, steps: Steps, view: int) -> UInt8[np.ndarray, "n h w 3"] | None:
        names = HEAD_CAMERA, *self.further_views
        return None if (False, *self.missing)[view] else self._grid().images(steps, names[view])

    def _span(self, place: WindowPosition, first: int) -> _Span:
        grid, kind = self._grid(), place.action_kind
        tactile_kpa, valid = grid.reader.touch(place.start, place.num_steps)
        count = place.start + place.num_steps - first
        kinds: set[ActionKind] = {"measured", kind}
        actions = {one: grid.reader.actions(first, count, kind=one) for one in kinds}
        objects, now_ns = None, grid.t_ref_ns[place.start : place.start + 1]
        if known := grid.boxed_objects(now_ns):
            objects = ObjectsAtStart(known[0][0].astype(np.float64), known[1])
        touch = tactile_kpa, valid, grid.measured_taxels
        about, anchor = grid.about.instruction, grid.reader.anchor(first)
        return _Span(about, first, anchor, grid.K_head, actions, touch, objects)


# An episode that windows are cut from.
TrainingEpisode: TypeAlias = EpisodeArrays | StoredEpisode
E = TypeVar("E", bound=TrainingEpisode)


def window_starts(episode: TrainingEpisode, num_steps: int) -> Int64[np.ndarray, " starts"]:
    """First steps of an episode's windows of so many steps, none of which is interpolated."""
    starts = np.arange(len(episode) - num_steps + 1)
    if episode.interpolated is None:
        return starts
    before = np.concatenate([[0], np.cumsum(episode.interpolated)])
    return starts[before[starts + num_steps] == before[starts]]


class WindowSampler:
    """Samples windows of measured steps uniformly over starts, and over episodes of each domain.

    Of windows from episodes with commanded actions, half have them, and 30 % of these are anchored
    like a later chunk. `human_share` is that of windows from human episodes, if there are both;
    None: every episode is equally likely. `dropout` has the shares of windows that remember no
    past, and of those without each further view.
    """

    def __init__(
        self,
        episodes: Sequence[TrainingEpisode],
        rng: np.random.Generator,
        *,
        max_steps: int,
        human_share: float | None = None,
        past: PastRule | None = None,
        dropout: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        short = [e.episode_id for e in episodes if not len(window_starts(e, max_steps))]
        if not episodes or short:
            raise InvalidInputError(
                f"training episodes: got {len(episodes)}, of which {len(short)} have no "
                f"{max_steps} measured steps in a row {short[:3]}; expected at least one episode "
                "and none too short"
            )
        self._episodes = list(episodes)
        self._rng = rng
        self._human = [i for i, episode in enumerate(episodes) if episode.domain == "human"]
        self._robot = [i for i, episode in enumerate(episodes) if episode.domain == "robot"]
        self._human_share = human_share if self._human and self._robot else None
        self._past, (self._past_dropout, self._view_dropout) = past, dropout

    def draw(self, batch: int, num_steps: int) -> WindowBatch:
        """A batch of random windows."""
        return self.cut(self.places(batch, num_steps))

    def places(self, batch: int, num_steps: int) -> list[WindowPosition]:
        """Places of the windows of the next batch."""
        return [self._place(num_steps) for _ in range(batch)]

    def cut(self, places: Sequence[WindowPosition]) -> WindowBatch:
        """The windows at these places."""
        return stack_windows([self._episodes[p.episode_index].cut(p) for p in places])

    def _place(self, num_steps: int) -> WindowPosition:
        able: Sequence[int] = range(len(self._episodes))
        if self._human_share is not None:
            able = self._human if self._rng.random() < self._human_share else self._robot
        index = able[int(self._rng.integers(len(able)))]
        episode = self._episodes[index]
        starts = window_starts(episode, num_steps)
        start = int(starts[self._rng.integers(len(starts))])
        is_commanded = bool(self._rng.random() < _COMMANDED_SHARE)
        is_chained = bool(self._rng.random() < _CHAINED_SHARE)
        is_commanded &= "commanded" in episode.action_kinds
        past, hidden = self._past, frozenset[int]()
        if past is not None and self._rng.random() < self._past_dropout:
            past = replace(past, kept=0)
        if num_views := len(episode.missing):
            rows = np.flatnonzero(self._rng.random(num_views) < self._view_dropout)
            hidden = frozenset(rows.tolist())
        kind: ActionKind = "commanded" if is_commanded else "measured"
        is_chained &= is_commanded
        return WindowPosition(
            index, start, num_steps, kind, from_command=is_chained, past=past, hidden=hidden
        )


def _selected(
    store: EpisodeStore, splits: Collection[Split], domain: Domain | None, image_px: int | None
) -> Iterator[EpisodeReader]:
    """Episodes that windows can be cut from; raises as `select_episodes`."""
    large = needs.Need(
        f"with images below {image_px} px",
        "record larger ones, or choose a smaller --network.image-px",
        lambda reader: image_px is None or min(reader.streams[HEAD_CAMERA].shape[:2]) >= image_px,
    )
    required = (needs.EVERY_PART, needs.EVERY_IMAGE, large)
    return select_episodes([store], domain=domain, splits=splits, needs=required)


def load_episodes(
    url: str,
    *,
    splits: Collection[Split] = (),
    domain: Domain | None = None,
    image_px: int | None = None,
    further_views: Sequence[str] = (),
) -> list[EpisodeArrays]:
    """Episodes of a store in memory; raises as `select_episodes` and `read_episode`."""
    readers = _selected(EpisodeStore(url), splits, domain, image_px)
    return [read_episode(one, image_px=image_px, further_views=further_views) for one in readers]


def index_episodes(
    url: str,
    *,
    splits: Collection[Split] = (),
    domain: Domain | None = None,
    image_px: int | None = None,
    further_views: Sequence[str] = (),
) -> list[StoredEpisode]:
    """`load_episodes`, for episodes that stay on disk; each is read once to be hashed."""
    # The episode of an id may have changed since it was last read.
    _reader.cache_clear()
    store, indexed = EpisodeStore(url), list[StoredEpisode]()
    for found in _selected(store, splits, domain, image_px):
        # The cached reader, so that processes forked later inherit it open.
        arrays = read_episode(
            _reader(url, found.item_id), image_px=image_px, further_views=further_views
        )
        shared: dict[str, Any] = {one.name: getattr(arrays, one.name) for one in fields(_Episode)}
        indexed.append(
            StoredEpisode(
                url=url,
                num_steps=len(arrays),
                action_kinds=arrays.action_kinds,
                missing=arrays.missing,
                print_sha256=arrays.fingerprint(),
                image_px=image_px,
                further_views=tuple(further_views),
                **shared,
            )
        )
    return indexed


class _Windows(Dataset[Window]):
    """Windows of episodes by their places; works in DataLoader workers, forked or spawned."""

    def __init__(self, episodes: Sequence[TrainingEpisode]) -> None:
        self._episodes = list(episodes)

    def __getitem__(self, place: WindowPosition) -> Window:
        return self._episodes[place.episode_index].cut(place)


def read_batches(
    episodes: Sequence[TrainingEpisode],
    places: Iterable[list[WindowPosition]],
    *,
    num_workers: int = 0,
) -> Generator[WindowBatch, None, None]:
    """Batches at these places, maybe endless, in order, whatever the number of reader processes."""
    loader = DataLoader(
        _Windows(episodes),
        batch_sampler=places,
        collate_fn=stack_windows,
        num_workers=num_workers,
        # Its own generator: otherwise the loader seeds its workers from the global one.
        generator=torch.Generator().manual_seed(0),
    )
    yield from loader
