"""Episodes as networks learn from them: which are fit, their arrays on the model grid, one hash."""

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cached_property
from typing import Final

import numpy as np
import structlog
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from dextouch.episodes.format import KINDS, Attributes, attributes_id, kind_of
from dextouch.episodes.needs import ACTIONS, OUTCOME, Need
from dextouch.episodes.object_poses import ObjectTrack, object_track
from dextouch.episodes.reader import OWN_IMAGE_SHARE, EpisodeReader
from dextouch.episodes.splits import Split, is_in, recording_of, scene_of, split_of
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.validity import interpolated_actions, measured_actions
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.geometry import undistorted
from dextouch.hands.actions import AnchorPoses
from dextouch.images import scaled_square, square_of_at_most
from dextouch.schemas import ActionKind, Domain, EpisodeAttributes, Observation, Origin
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile.layout import TactileLayout

Span = tuple[float, float]
TRUE_ORIGINS: Final[tuple[Origin, ...]] = ("recorded", "twin")

logger = structlog.get_logger(__name__)


def is_rejected(
    store: EpisodeStore, about: Attributes, *, others: Iterable[EpisodeStore] = ()
) -> bool:
    """Whether an episode or recording must not be trained on, by its own review.

    One without a review is rejected with a recording or episode that it was made from, if that is
    in the same store or in one of `others`. An item that was edited is rejected as long as one
    of the results is in one of these stores, and the results are not rejected with it.
    """
    places, own_kind = (store, *others), kind_of(about)
    own = store.review(attributes_id(about), kind=own_kind)
    own = own and own.standing(
        lambda name: any(place.exists(name, kind=own_kind) for place in places)
    )
    if own is not None or not isinstance(about, EpisodeAttributes):
        return own is not None and own.verdict == "rejected"
    return any(
        (review := place.review(source.id, kind=kind)) is not None and review.spreads
        for source in about.lineage
        for kind in KINDS
        if source.kind == kind
        for place in places
        if place.has_source(source)
    )


def select_episodes(
    stores: Sequence[EpisodeStore],
    *,
    domain: Domain | None = None,
    tasks: Collection[str] = (),
    splits: Collection[Split] = (),
    origins: Collection[Origin] = TRUE_ORIGINS,
    needs: Sequence[Need] = (),
) -> Iterator[EpisodeReader]:
    """Episodes that are fit for a learner, store by store in the order of their ids.

    Those that were rejected in review and those that lack what is needed, beside actions, are left
    out, counted and logged by reason. A domain of None is people and robots; tasks, splits of their
    scenes and origins that are empty are all.

    Raises:
        NotFoundError: an empty store, or no such episode; what those that there are lack is named.
        ConflictError: an id in two stores, two episodes of one recording, or other model rates.
    """
    passed_over: Counter[str] = Counter()
    unfit: Counter[str] = Counter()
    chosen = _Chosen()
    for place, store in enumerate(stores, 1):
        if not (names := store.list()):
            raise NotFoundError(
                f"episodes: store {place} of {len(stores)}, {store.url}, has none; check its path"
            )
        others = [one for one in stores if one is not store]
        for name in sorted(names):
            reader = store.open(name)
            about = reader.attributes
            if other := _other(about, domain, tasks, splits, origins):
                passed_over[other] += 1
            elif is_rejected(store, about, others=others):
                unfit["rejected in review"] += 1
            elif lacking := next((n for n in (ACTIONS, *needs) if not n.is_met(reader)), None):
                counts = passed_over if lacking.is_choice else unfit
                counts[f"{lacking.lack} ({lacking.remedy})"] += 1
            else:
                chosen.add(reader)
                yield reader
    for reason, count in unfit.items():
        logger.warning("skipped_episodes", reason=reason, count=count)
    if not chosen.names:
        asked = f"{domain or 'human or robot'} episode of {', '.join(tasks) or 'any task'}"
        asked += f" in splits {', '.join(splits)}" if splits else ""
        raise NotFoundError(
            f"no {asked} that can be used in {', '.join(store.url for store in stores)}, only "
            f"{', '.join(f'{n} {why}' for why, n in (passed_over + unfit).items())}; record some "
            "at a station, or in the twin by `dextouch train data`"
        )


def _other(
    about: EpisodeAttributes,
    domain: Domain | None,
    tasks: Collection[str],
    splits: Collection[Split],
    origins: Collection[Origin],
) -> str | None:
    """Why an episode is none of those that were asked for; None if it is one."""
    if domain not in {None, about.domain}:
        return f"of {'people' if about.domain == 'human' else 'robots'}"
    if tasks and about.task not in tasks:
        return f"of task {about.task!r}"
    if origins and about.origin not in origins:
        return f"of origin {about.origin!r}"
    return None if is_in(about, splits) else f"of split {split_of(about)}"


class _Chosen:
    """Episodes chosen so far; each one added must go together with them."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        # Ids and time spans (ns) by recording.
        self._of_recording: defaultdict[str, list[tuple[str, Span]]] = defaultdict(list)
        self._first: EpisodeAttributes | None = None

    def add(self, reader: EpisodeReader) -> None:
        """Add an episode; raises ConflictError if it is there already, or at another rate."""
        about = reader.attributes
        name, first = about.episode_id, self._first or about
        if name in self.names:
            raise ConflictError(f"episode {name!r}: in two stores; pass only one of them")
        recording = recording_of(about) if about.origin == "recorded" else None
        if recording is not None:
            span, same = _span_ns(reader), self._of_recording[recording]
            other = next(
                (one for one, (low, high) in same if low <= span[1] and span[0] <= high), ""
            )
            if other:
                raise ConflictError(
                    f"episodes {other!r} and {name!r}: are of one recording, aligned with "
                    "different options, or edited; expected one, or parts without common steps; "
                    "delete the other with `dextouch store delete`"
                )
            same.append((name, span))
        if about.model_rate_hz != first.model_rate_hz:
            raise ConflictError(
                f"episodes {first.episode_id!r} and {name!r}: have model rates of "
                f"{first.model_rate_hz:g} and {about.model_rate_hz:g} Hz, expected one; align them "
                "at one rate (`dextouch align serve --options.model-rate-hz`)"
            )
        self.names.add(name)
        self._first = first


def _span_ns(reader: EpisodeReader) -> Span:
    """When the steps begin and end, after the start of the recording; all time if unknown."""
    about = reader.attributes
    origin_ns = about.quality.get("origin_after_start_ns")
    if origin_ns is None:
        return -math.inf, math.inf
    return origin_ns, origin_ns + (reader.num_steps - 0.5) * 1e9 / about.model_rate_hz


def data_hash(contents: Iterable[str], **options: object) -> str:
    """SHA-256 of a set of episodes, in any order, as every checkpoint notes what it learned from.

    Of their `content_sha256`, of which outcomes, event times and all else that labels are made of
    are a part, and of options that decide the arrays, such as `image_px`; None is the usual and
    left out.
    """
    lines = [*sorted(contents), *(f"{k}={v}" for k, v in sorted(options.items()) if v is not None)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


class EpisodeGrid:
    """One episode on the model grid, read when it is asked for.

    Touch and images, which take the memory, are read anew by each call; only the images that are
    asked for are decoded.

    Args:
        reader: the episode.
        image_px: side that the middle square of larger images is scaled to; None for no scaling.

    Attributes:
        about: domain, origin, outcome, event times, names of objects and so on.
    """

    def __init__(self, reader: EpisodeReader, image_px: int | None = None) -> None:
        self.reader, self.image_px = reader, image_px
        self.about: EpisodeAttributes = reader.attributes

    def __len__(self) -> int:
        return self.reader.num_steps

    @property
    def episode_id(self) -> str:
        """Id in its store."""
        return self.about.episode_id

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.about.task

    @property
    def domain(self) -> Domain:
        """Whose hands act."""
        return self.about.domain

    @property
    def scene(self) -> str:
        """Name of the scene, from `scene_of`."""
        return scene_of(self.about)

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects."""
        return self.about.object_names

    @property
    def success(self) -> bool:
        """The outcome; raises InvalidInputError if it is unknown (the need `OUTCOME`)."""
        if self.about.success is None:
            raise InvalidInputError(f"episode {self.episode_id!r}: is {OUTCOME.lack}")
        return self.about.success

    @cached_property
    def content_sha256(self) -> str:
        """Digest of all that the store holds of it, for `data_hash`."""
        return self.reader.content_sha256

    @property
    def t_ref_ns(self) -> Int64[np.ndarray, " steps"]:
        """Times of the steps on the episode's clock."""
        return self.reader.stamps_ns("action")

    @cached_property
    def anchor(self) -> AnchorPoses:
        """Measured poses of wrists and head camera at step 0, in the world."""
        return self.reader.anchor(0)

    @cached_property
    def interpolated(self) -> Bool[np.ndarray, " steps"]:
        """Steps of which alignment interpolated some part of the action across a gap."""
        if not any(name.startswith("interpolated_") for name in self.about.calibration):
            return np.zeros(len(self), dtype=np.bool_)
        kinds: set[ActionKind] = {"measured", self.action_kind}
        columns = [interpolated_actions(self.about.calibration, self.t_ref_ns, k) for k in kinds]
        return np.asarray(np.any(columns, axis=(0, 2)))

    def is_measured(self, first: int, stop: int) -> bool:
        """Whether no action of the steps first … stop − 1 is interpolated."""
        return not self.interpolated[first:stop].any()

    @cached_property
    def measured_columns(self) -> Bool[np.ndarray, "steps 67"]:
        """Columns of the actions that were measured, neither interpolated nor absent."""
        return measured_actions(self.about, self.t_ref_ns)

    @cached_property
    def measured(self) -> Float64[np.ndarray, "steps 67"]:
        """Measured actions, relative to `anchor`."""
        return self.reader.actions(0, len(self))

    @cached_property
    def action_kind(self) -> ActionKind:
        """Kind of the actions `sent`."""
        return "commanded" if "action_commanded" in self.reader.streams else "measured"

    @cached_property
    def sent(self) -> Float64[np.ndarray, "steps 67"]:
        """Commanded actions as stored, relative to `anchor`; `measured` where there are none."""
        if self.action_kind == "measured":
            return self.measured
        return self.reader.read("action_commanded").values.astype(np.float64)

    def touch(self) -> tuple[Float32[np.ndarray, "steps 2 taxels"], Bool[np.ndarray, "steps 2"]]:
        """Mean pressures (kPa) of each step, and where there was a sample."""
        return self.reader.touch(0, len(self))

    @property
    def measured_taxels(self) -> Bool[np.ndarray, "2 taxels"]:
        """Taxels that were measured; the others, which alignment refused, are zero throughout."""
        return self.reader.measured_taxels

    @property
    def tactile_layout(self) -> TactileLayout:
        """Layout of the taxels."""
        return self.reader.tactile_layout

    @cached_property
    def image_steps(self) -> Int64[np.ndarray, " shown"]:
        """Steps that have a head camera image of their own."""
        return self.reader.shown_steps(HEAD_CAMERA)[0]

    @cached_property
    def K_head(self) -> Float64[np.ndarray, "3 3"]:  # noqa: N802 (K is the camera matrix)
        """Matrix of the head camera (px), for the size of `images`."""
        K = self.about.K_head_matrix()
        if self.image_px is None:
            return K
        no_images = np.zeros((0, *self._size_px(), 3), dtype=np.uint8)
        return scaled_square(no_images, K, self.image_size_px[0])[1]

    @cached_property
    def image_size_px(self) -> tuple[int, int]:
        """Height and width of `images`."""
        size_px = self._size_px()
        side_px = None if self.image_px is None else min(self.image_px, *size_px)
        return size_px if side_px is None else (side_px, side_px)

    def _size_px(self) -> tuple[int, int]:
        height_px, width_px, _ = self.reader.streams[HEAD_CAMERA].shape
        return height_px, width_px

    def images(
        self, steps: Sequence[int] | np.ndarray, camera: str = HEAD_CAMERA
    ) -> UInt8[np.ndarray, "n h w 3"]:
        """The image of a camera nearest to each of some non-decreasing steps, whatever its own.

        Those of the head are undistorted: as a pinhole camera with `K_head` would have taken them.
        """
        return self._nearest(steps, camera)[1]

    def own_images(self, steps: Sequence[int] | np.ndarray) -> UInt8[np.ndarray, "n h w 3"] | None:
        """Head camera images of some non-decreasing steps; None if one has none of its own."""
        offset_ns, images = self._nearest(steps)
        reach_ns = OWN_IMAGE_SHARE * 1e9 / self.about.model_rate_hz
        return images if (np.abs(offset_ns) <= reach_ns).all() else None

    def _nearest(
        self, steps: Sequence[int] | np.ndarray, camera: str = HEAD_CAMERA
    ) -> tuple[Int64[np.ndarray, " n"], UInt8[np.ndarray, "n h w 3"]]:
        times_ns = self.t_ref_ns[np.asarray(steps)]
        indices, images = self.reader.nearest_pictures(camera, times_ns)
        K = self.about.K_head_matrix()
        if camera == HEAD_CAMERA:
            images = undistorted(images, K, self.about.head_distortion())
        scaled, _ = square_of_at_most(images, K, self.image_px)
        return self.reader.stamps_ns(camera)[indices] - times_ns, scaled

    def observation(self, step: int = 0, further_views: Iterable[str] = ()) -> Observation:
        """What a rollout from a step observes first, with those further views that there are."""
        cameras = (HEAD_CAMERA, *(view for view in further_views if view in self.reader.streams))
        return Observation(
            first_step=0,
            images={camera: self.images([step], camera) for camera in cameras},
            tactile_kpa=self.reader.touch(step, 1)[0],
            action_reached=self.reader.actions(step, 1),
            reached_is_measured=True,
        )

    @cached_property
    def objects(self) -> ObjectTrack | None:
        """Poses of the objects at every step; None if the episode has none."""
        return object_track(self.reader, self.t_ref_ns)

    @cached_property
    def boxes_m(self) -> Float64[np.ndarray, "objects 6"]:
        """Boxes of the objects in their own frames, middle and half sizes; none if unknown."""
        return np.array(self.about.object_boxes_m, dtype=np.float64).reshape(-1, 6)

    def boxed_objects(
        self, t_ref_ns: Int64[np.ndarray, " n"]
    ) -> tuple[Float32[np.ndarray, "n objects 7"], Float64[np.ndarray, "objects 6"]] | None:
        """Poses of the objects at given times, and their boxes; None unless all are known."""
        track = object_track(self.reader, t_ref_ns)
        if track is None or not len(self.boxes_m) or not track.known.all():
            return None
        return track.poses, self.boxes_m
