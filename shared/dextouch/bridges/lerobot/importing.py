"""Import of LeRobot datasets: those with our actions as episodes, all others as recordings."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int64
from pydantic import ValidationError

from dextouch.bridges.import_recording import (
    MAX_ID,
    ForeignStream,
    ImageUnit,
    ImportedStream,
    ImportReport,
    Refused,
    file_sha256,
    printable,
    stream_names,
    whole_text,
)
from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.layout import WORLD
from dextouch.bridges.lerobot.recordings import (
    COUNTERS,
    TASK_INDEX,
    Frames,
    ImportOptions,
    camera_stream,
    dataset_contradictions,
    dataset_id,
    feature_streams,
    recordings_importer,
)
from dextouch.bridges.lerobot.source import (
    DatasetInfo,
    EpisodeEntry,
    FeatureInfo,
    LeRobotFolder,
)
from dextouch.episodes import EpisodeStore, Kind
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    UnknownNameError,
)
from dextouch.hands.actions import (
    ACTION_DIM,
    AnchorPoses,
    action_names,
    poses_from_actions,
    reanchor,
)
from dextouch.schemas import (
    MAX_INSTRUCTION,
    EpisodeAttributes,
    LineageEntry,
    StoredAnchor,
    first_problems,
)
from dextouch.streams import HEAD_CAMERA, StreamDescriptor, StreamKind
from dextouch.tactile.layout import DEXTOUCH_V1, SIDES, TactileLayout

TOUCH_STREAMS = tuple(f"tactile_{side}" for side in SIDES)
_CAMERA_NAME = re.compile(r"camera_[a-z0-9_]{1,57}")
# Usual feature of a role, and the shape of its rows; -1 is the number of taxels.
_ROLES = {
    "action": (layout.ACTION, (ACTION_DIM,)),
    "state": (layout.STATE, (ACTION_DIM,)),
    "tactile": (layout.TACTILE, (2, -1)),
}
# What our own exports keep beside LeRobot's features; None: one number a camera.
_OURS: dict[str, tuple[str, tuple[int, ...] | None]] = {
    layout.MEASURED: ("float32", (ACTION_DIM,)),
    layout.VALID: ("bool", (2,)),
    layout.STAMP: ("int64", (1,)),
    layout.IMAGE_DT: ("int64", None),
}


DEFAULTS = ImportOptions()


@dataclass
class DatasetImport:
    """Result of an import: what was written under which ids, and what was not.

    `reports` has one for each id; those of our own exports list no streams. `present` are the ids
    of what the store had from the same files, and `failed` the errors of the other episodes.
    """

    kind: Kind
    ids: list[str] = field(default_factory=list)
    present: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    reports: list[ImportReport] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """Plain JSON values."""
        return asdict(self)

    def lines(self) -> Iterator[str]:
        """The result for a terminal: all of the first recording, of others what is new."""
        return map(printable, self._lines())

    def _lines(self) -> Iterator[str]:
        yield from self.notes
        printed: set[str] = set()
        for report in self.reports:
            head, *rest = report.lines()
            yield head if report.imported else report.recording_id
            kinds_of_problems = ("  refused", "  contradiction")
            new_lines = [one for one in rest if not printed or one.startswith(kinds_of_problems)]
            yield from (one for one in new_lines if one not in printed)
            printed.update(rest)
        if self.present:
            yield f"{len(self.present)} episodes of these files are in the store already"


def import_dataset(
    folder: Path, store: EpisodeStore, *, options: ImportOptions = DEFAULTS
) -> DatasetImport:
    """Write every episode of a dataset into the store, as an episode or else as a recording.

    Our own exports become episodes, and so do datasets with a 67-D action and a head camera.
    Everything else becomes recordings, with a stream for each feature. Each appears complete or not
    at all; one that fails is listed in `failed` and the next one is tried. Those that the store has
    from the same files are skipped, so that an import can be repeated. Nothing outside the folder
    is read.

    Raises, if no episode can be imported, what the first one of them raised:
        NotFoundError: a file is missing.
        UnknownNameError: a mapping of an unknown name, or to a feature that the dataset lacks.
        InvalidInputError: another version of the format, or options that do not fit.
        CorruptDataError: damaged or truncated files, or paths that lead out of the folder.
        LimitExceededError: larger than the limits of this reader.
        ConflictError: an id exists already.
    """
    source = LeRobotFolder(folder)
    result, import_one = _importer(source, store, options)
    errors = []
    for entry in source.episodes:
        try:
            import_one(entry)
        except DexTouchError as error:
            result.failed[f"episode {entry.index}"] = error.message
            errors.append(error)
    if errors and not (result.ids or result.present):
        raise errors[0]
    return result


def _importer(
    source: LeRobotFolder, store: EpisodeStore, options: ImportOptions
) -> tuple[DatasetImport, Callable[[EpisodeEntry], None]]:
    """The result, still empty, and what adds an episode to it."""
    folder = source.folder
    first = source.sidecar(source.episodes[0]) if source.episodes else None
    features, missing = _map_features(source.info, options.mapping, first)
    if first is None and missing:
        result = DatasetImport("recording", notes=[f"imported as recordings: {'; '.join(missing)}"])
        write = recordings_importer(source, store, options)

        def import_recording(entry: EpisodeEntry) -> None:
            report = write(entry)
            (result.ids if report.imported else result.present).append(report.recording_id)
            result.reports += [report] if report.imported else []

        return result, import_recording
    if missing:
        raise InvalidInputError(f"{folder}: an export of DexTouch that is changed: {missing}")
    if options.fps is not None:
        raise InvalidInputError(f"--fps: {folder} has our actions, whose rate cannot be changed")
    for name, key in options.mapping.items():
        is_taken = first is not None or key in features.values()
        if is_taken and name not in {*_ROLES, *features}:
            raise UnknownNameError(f"name of feature {key!r} (--map)", name, [*_ROLES, "camera_…"])
    result = DatasetImport("episode")
    about = dataset_contradictions(source)

    def import_episode(entry: EpisodeEntry) -> None:
        report = _import_episode(source, store, entry, features, options, result)
        if report is not None:
            report.contradictions += about
            result.ids.append(report.recording_id)
            result.reports.append(report)

    return result, import_episode


def _import_episode(
    source: LeRobotFolder,
    store: EpisodeStore,
    entry: EpisodeEntry,
    features: Mapping[str, str],
    options: ImportOptions,
    result: DatasetImport,
) -> ImportReport | None:
    sidecar = source.sidecar(entry)
    content, anchor = _content(source, entry, features, sidecar, options.images)
    refused: list[Refused] = []
    if sidecar is None:
        changes = _foreign_attributes(source, entry, anchor, options)
        refused = _add_others(content, source, entry, features, options)
    else:
        changes = _known_attributes(source, anchor, sidecar, options)
    try:
        attributes = EpisodeAttributes.model_validate(changes)
    except ValidationError as error:
        raise InvalidInputError(
            f"import from LeRobot: the options make no episode ({first_problems(error)})"
        ) from error
    if store.exists(attributes.episode_id):
        if store.open(attributes.episode_id).attributes.lineage == attributes.lineage:
            result.present.append(attributes.episode_id)
            return None
        raise ConflictError(
            f"episode {attributes.episode_id!r} exists already; give another "
            "id_prefix (`dextouch import --id-prefix`)"
        )
    report = ImportReport(attributes.episode_id, whole_text(source.folder.name), refused=refused)
    report.imported = _store(store, attributes, content, features)
    if sidecar is not None:
        notes = [f"{one.source}: {note}" for one in report.imported for note in one.notes]
        result.notes += [note for note in notes if note not in result.notes]
        report.imported = []
    return report


def _tactile_layout(sidecar: layout.Sidecar | None) -> TactileLayout:
    """Layout of the taxels of an episode of ours; datasets of other origin have `dextouch_v1`."""
    streams = () if sidecar is None else sidecar.attributes.streams
    touch = [one.tactile_layout for one in streams if one.name in TOUCH_STREAMS]
    return touch[0] if touch else DEXTOUCH_V1


def _map_features(
    info: DatasetInfo, names: Mapping[str, str], first: layout.Sidecar | None
) -> tuple[dict[str, str], list[str]]:
    """The dataset's features by role, and why it has no episodes of ours (empty if it has)."""
    for theirs in names.values():
        if theirs not in info.features:
            raise UnknownNameError("feature of the dataset (--map)", theirs, list(info.features))
    roles: dict[str, str] = {}
    problems = []
    num_taxels = _tactile_layout(first).num_taxels
    for ours, (usual, sizes) in _ROLES.items():
        shape = tuple(num_taxels if size < 0 else size for size in sizes)
        name = names.get(ours, usual)
        got = info.features.get(name)
        if got is not None and got.dtype in {"float32", "float64"} and got.numbers() == shape:
            roles[ours] = name
        elif ours == "action" or ours in names:
            said = f"{name!r} is {_describe(got)}, expected float32 {[*shape]}" if got else ""
            problems.append(f"{ours!r}: {said or f'no feature {name!r}'}")
    exported = None if first is None else first.cameras
    cameras = _cameras(info, names, exported or ())
    if HEAD_CAMERA not in cameras and (exported is None or HEAD_CAMERA in exported):
        problems.append(
            f"{HEAD_CAMERA!r}: no feature {layout.IMAGES + HEAD_CAMERA!r} "
            f"(--map {HEAD_CAMERA}=FEATURE)"
        )
    problems += [
        f"{ours!r}: {name!r} is {_describe(info.features[name])}, expected images [h, w, 3]"
        for ours, name in cameras.items()
        if not info.features[name].has_colours()
    ]
    return roles | cameras, problems


def _cameras(
    info: DatasetInfo, names: Mapping[str, str], exported: Collection[str]
) -> dict[str, str]:
    """Cameras under our own names or those of an export, and those given by the mapping."""
    own = {
        ours: name
        for name, feature in info.features.items()
        if name.startswith(layout.IMAGES) and feature.is_camera() and name not in names.values()
        for ours in [name.removeprefix(layout.IMAGES)]
        if ours in exported or _CAMERA_NAME.fullmatch(ours)
    }
    given = {o: t for o, t in names.items() if o not in _ROLES and _CAMERA_NAME.fullmatch(o)}
    return own | given


def _describe(feature: FeatureInfo) -> str:
    return f"{feature.dtype} {list(feature.shape)}"


@dataclass(frozen=True)
class _Content:
    """Streams of an episode with one row per step.

    `numbers` has the kind, unit and values of each, and which steps have one; `others` are cameras,
    and in datasets of other origin what no role takes. A stamp that comes twice is one image, the
    nearest to two steps.
    """

    t_ref_ns: Int64[np.ndarray, " n"]
    numbers: dict[str, tuple[StreamKind, str, np.ndarray, Bool[np.ndarray, " n"]]]
    others: list[ForeignStream]
    tactile_layout: TactileLayout

    def add_touch(
        self, kpa: Float32[np.ndarray, "n 2 taxels"], valid: Bool[np.ndarray, "n 2"]
    ) -> None:
        """Add the streams of the hands that were sensed at any step."""
        for hand, side in enumerate(SIDES):
            if (keep := valid[:, hand]).any():
                self.numbers[f"tactile_{side}"] = ("tactile", "kPa", kpa[:, hand], keep)


def _content(
    source: LeRobotFolder,
    entry: EpisodeEntry,
    features: Mapping[str, str],
    sidecar: layout.Sidecar | None,
    images: ImageUnit | None,
) -> tuple[_Content, AnchorPoses | None]:
    """An episode's numbers, where its images are, and the poses that its actions are relative to.

    These are the measured ones of the first frame; None where the dataset's description gives them.
    """
    where = f"{source.folder}: episode {entry.index}"
    columns = _columns(source, entry, features)
    t_ns = columns.get(layout.STAMP)
    if t_ns is None:
        t_ns = np.rint(np.arange(entry.length) * (1e9 / source.info.fps))
    t_ns = t_ns.astype(np.int64)
    if (np.diff(t_ns) <= 0).any():
        raise CorruptDataError(f"{where}: {layout.STAMP!r} does not rise from frame to frame")
    measured, commanded, anchor = _actions(columns, features, sidecar, where)
    content = _Content(t_ns, {}, [], _tactile_layout(sidecar))
    if "tactile" in features:
        valid = columns.get(layout.VALID, np.ones((entry.length, 2))).astype(bool)
        content.add_touch(columns[features["tactile"]].astype(np.float32), valid)
    everywhere = np.ones(entry.length, dtype=bool)
    for name, actions in (("action", measured), ("action_commanded", commanded)):
        if actions is not None:
            content.numbers[name] = ("robot_state", "action", actions, everywhere)
    frames = Frames(source, entry, t_ns, source.info.fps)
    for camera, key in features.items():
        if camera in _ROLES:
            continue
        stamps = _image_stamps(source, key, t_ns, columns.get(layout.IMAGE_DT), where)
        stream = camera_stream(frames, key, camera, stamps, images)
        if isinstance(stream, str):
            raise InvalidInputError(f"{where}: {key!r} {stream}")
        content.others.append(stream)
    return content, anchor


def _add_others(
    content: _Content,
    source: LeRobotFolder,
    entry: EpisodeEntry,
    features: Mapping[str, str],
    options: ImportOptions,
) -> list[Refused]:
    """Add a stream of each feature that has no role, and return those that cannot be one."""
    taken = {*features.values(), *COUNTERS, TASK_INDEX, *_OURS}
    left = [key for key in source.info.features if key not in taken]
    ours = [*content.numbers, *(one.descriptor.name for one in content.others)]
    # Names of our own streams come first, so that no other gets one of them.
    given = {name: key for name, key in options.mapping.items() if key in left}
    names = stream_names([*ours, *left], {name: name for name in ours} | given)
    frames = Frames(source, entry, content.t_ref_ns, source.info.fps)
    streams, refused = feature_streams(frames, {key: names[key] for key in left}, options.images)
    content.others.extend(streams)
    return refused


def _store(
    store: EpisodeStore,
    attributes: EpisodeAttributes,
    content: _Content,
    features: Mapping[str, str],
) -> list[ImportedStream]:
    """Write an episode into the store, atomically."""
    imported = []
    with store.writer(attributes=attributes) as writer:
        for name, (kind, unit, values, keep) in content.numbers.items():
            fields: dict[str, object] = {"name": name, "kind": kind, "unit": unit}
            fields |= {"shape": values.shape[1:], "dtype": str(values.dtype)}
            fields |= {"nominal_rate_hz": attributes.model_rate_hz}
            if kind == "tactile" and content.tactile_layout != DEXTOUCH_V1:
                fields["layout"] = content.tactile_layout
            about, t_ns = StreamDescriptor.model_validate(fields), content.t_ref_ns[keep]
            writer.add_stream(about)
            writer.append(name, values=values[keep], t_ref_ns=t_ns)
            imported.append(_timed(about, features[name.partition("_")[0]], [t_ns]))
        for stream in content.others:
            about, stamps = stream.descriptor, []
            writer.add_stream(about)
            for block in stream.blocks:
                writer.append(about.name, values=block.values, t_ref_ns=block.t_ns)
                stamps.append(block.t_ns)
            imported.append(_timed(about, stream.source, stamps, stream.notes))
    return imported


def _timed(
    about: StreamDescriptor, source: str, stamps_ns: Sequence[np.ndarray], notes: Sequence[str] = ()
) -> ImportedStream:
    one, t_ns = ImportedStream.of(about, source), np.concatenate(stamps_ns)
    one.num_samples, one.notes = len(t_ns), tuple(notes)
    one.set_span(int(t_ns.min()), int(t_ns.max()))
    return one


def _columns(
    source: LeRobotFolder, entry: EpisodeEntry, features: Mapping[str, str]
) -> dict[str, np.ndarray]:
    wanted = [features[role] for role in _ROLES if role in features]
    for name, (dtype, shape) in _OURS.items():
        feature = source.info.features.get(name)
        if feature is None:
            continue
        if feature.dtype != dtype or (shape is not None and feature.shape != shape):
            raise CorruptDataError(
                f"{source.folder}: feature {name!r} is {feature.dtype} {list(feature.shape)}, "
                f"expected {dtype} {list(shape or ['cameras'])}"
            )
        wanted.append(name)
    columns, ours = source.columns(entry, wanted), tuple(action_names())
    for name in {features[role] for role in ("action", "state") if role in features}:
        names = source.info.features[name].component_names()
        if names != ours and sorted(names) == sorted(ours):
            columns[name] = columns[name][:, [names.index(one) for one in ours]]
    return columns


def _actions(
    columns: dict[str, np.ndarray],
    features: Mapping[str, str],
    sidecar: layout.Sidecar | None,
    where: str,
) -> tuple[np.ndarray, np.ndarray | None, AnchorPoses | None]:
    """Measured and commanded actions, and the poses that they are relative to."""
    action = columns[features["action"]].astype(np.float64)
    if sidecar is None:
        if "state" not in features:
            return action, None, None
        state = columns[features["state"]][:1].astype(np.float64)
        return action, None, poses_from_actions(state, WORLD).anchor(0)
    measured, commanded = action, None
    if sidecar.action_kind == "commanded":
        if layout.MEASURED not in columns:
            raise CorruptDataError(f"{where}: feature {layout.MEASURED!r} is missing")
        measured, commanded = columns[layout.MEASURED].astype(np.float64), action
    if sidecar.grid == "model":
        return measured, commanded, None
    # Frame 0 need not be step 0: actions become relative to what they now begin with.
    anchor = poses_from_actions(measured[:1], sidecar.attributes.anchor.to_poses()).anchor(0)
    if commanded is not None:
        commanded = reanchor(commanded, 0, anchor_action=measured[0])
    return reanchor(measured, 0), commanded, anchor


def _image_stamps(
    source: LeRobotFolder, key: str, t_ns: np.ndarray, offsets_ns: np.ndarray | None, where: str
) -> Int64[np.ndarray, " n"]:
    """Stamp of the image of each frame: the frame's own where the dataset says nothing."""
    if offsets_ns is None:
        return t_ns
    names = source.info.features[layout.IMAGE_DT].names
    columns = offsets_ns.reshape(len(t_ns), -1)
    camera = key.removeprefix(layout.IMAGES)
    if not isinstance(names, list) or camera not in names[: columns.shape[1]]:
        return t_ns
    stamps = t_ns + columns[:, names.index(camera)].astype(np.int64)
    if (np.diff(stamps) < 0).any():
        raise CorruptDataError(f"{where}: stamps of {camera!r} in {layout.IMAGE_DT!r} go back")
    return stamps


def _known_attributes(
    source: LeRobotFolder,
    anchor: AnchorPoses | None,
    sidecar: layout.Sidecar,
    options: ImportOptions,
) -> dict[str, object]:
    """The exported attributes, with the anchor of the first frame and the source in the lineage."""
    known = sidecar.attributes
    came_from = LineageEntry(kind="episode", id=known.episode_id, sha256=sidecar.content_sha256)
    return known.model_dump() | {
        "episode_id": f"{options.id_prefix}{known.episode_id}",
        "model_rate_hz": float(source.info.fps),
        "lineage": (*known.lineage, came_from),
        "anchor": known.anchor if anchor is None else StoredAnchor.from_poses(anchor),
        "streams": (),
    }


def _foreign_attributes(
    source: LeRobotFolder, entry: EpisodeEntry, anchor: AnchorPoses | None, options: ImportOptions
) -> dict[str, object]:
    name = whole_text(source.folder.resolve().name)
    digest = file_sha256(source.data_file(entry))
    came_from = f"lerobot:{name}/episode-{entry.index:06d}"
    return {
        "episode_id": options.id_prefix
        + dataset_id(source, entry, MAX_ID - len(options.id_prefix)),
        "task": (options.task or entry.task or "unknown")[:128],
        "instruction": (options.instruction or entry.task)[:MAX_INSTRUCTION],
        "domain": options.domain,
        "origin": "recorded",
        "model_rate_hz": float(source.info.fps),
        "anchor": StoredAnchor.from_poses(anchor or WORLD),
        "K_head": options.K_head,
        "lineage": (LineageEntry(kind="recording", id=came_from, sha256=digest),),
    }
