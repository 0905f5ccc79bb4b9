"""Import of LeRobotDataset v3 folders as episodes of the store."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int64
from pydantic import ValidationError

from dextouch.bridges.exporting import BLOCK_IMAGES
from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.layout import WORLD
from dextouch.bridges.lerobot.source import DatasetInfo, EpisodeEntry, FeatureInfo, LeRobotFolder
from dextouch.bridges.lerobot.video import VideoSpan, read_images, read_units
from dextouch.episodes import GOP_IMAGES, EpisodeStore, EpisodeWriter, disk_errors, is_keyframe
from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, AnchorPoses, poses_from_actions, reanchor
from dextouch.schemas import (
    Domain,
    EpisodeAttributes,
    LineageEntry,
    Matrix,
    StoredAnchor,
    first_problems,
)
from dextouch.streams import StreamDescriptor, StreamKind, encoded_values
from dextouch.tactile.layout import DEXTOUCH_V1, SIDES, TactileLayout

ImageUnit = Literal["h264", "jpeg", "rgb8"]
HEAD = "camera_head"
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


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import: information that the dataset itself lacks.

    `mapping`: our name → the dataset's feature, for features under other names: `action`, `state`,
    `tactile` and cameras (`camera_head`, `camera_wrist_left`, …). `id_prefix`: put before every id
    (needed when ids exist already); `images`: the unit that images are stored in. Only for datasets
    of other origin: `K_head` in pixels, `domain` and `task` (without it the dataset's own text).
    """

    mapping: Mapping[str, str] = field(default_factory=dict)
    id_prefix: str = ""
    images: ImageUnit = "h264"
    K_head: Matrix | None = None
    domain: Domain = "robot"
    task: str | None = None


DEFAULTS = ImportOptions()


def import_lerobot(
    folder: Path, store: EpisodeStore, *, options: ImportOptions = DEFAULTS
) -> list[str]:
    """Write every episode of a dataset into the store and return their ids.

    Each episode appears complete or not at all; after an error, earlier episodes remain. Nothing
    outside the folder is read.

    Raises:
        NotFoundError: a file is missing.
        UnknownNameError: a mapping of an unknown name, or to a feature that the dataset lacks.
        InvalidInputError: another version of the format, or features that do not fit; all are
            listed, with what the dataset has.
        CorruptDataError: damaged or truncated files, or paths that lead out of the folder.
        LimitExceededError: larger than the limits of this reader.
        ConflictError: an id exists already.
    """
    source = LeRobotFolder(folder)
    first = source.sidecar(source.episodes[0]) if source.episodes else None
    features = _map_features(source.info, options.mapping, _tactile_layout(first))
    ids: list[str] = []
    for entry in source.episodes:
        sidecar = source.sidecar(entry)
        content, anchor = _content(source, entry, features, sidecar)
        if sidecar is None:
            changes = _foreign_attributes(source, entry, anchor, features, options)
        else:
            changes = _known_attributes(source, anchor, sidecar, options)
        try:
            attributes = EpisodeAttributes.model_validate(changes)
        except ValidationError as error:
            raise InvalidInputError(
                f"import from LeRobot: the options make no episode ({first_problems(error)})"
            ) from error
        if store.exists(attributes.episode_id):
            raise ConflictError(
                f"episode {attributes.episode_id!r} exists already; give another "
                "id_prefix (`dextouch import --id-prefix`)"
            )
        _store(store, attributes, content, options.images)
        ids.append(attributes.episode_id)
    return ids


def _tactile_layout(sidecar: layout.Sidecar | None) -> TactileLayout:
    """Layout of the taxels of an episode of ours; datasets of other origin have `dextouch_v1`."""
    streams = () if sidecar is None else sidecar.attributes.streams
    touch = [one.tactile_layout for one in streams if one.name in TOUCH_STREAMS]
    return touch[0] if touch else DEXTOUCH_V1


def _map_features(
    info: DatasetInfo, names: Mapping[str, str], tactile: TactileLayout
) -> dict[str, str]:
    """The dataset's features by role; roles and cameras that it has no feature for are absent."""
    for ours, theirs in names.items():
        if ours not in _ROLES and not _CAMERA_NAME.fullmatch(ours):
            raise UnknownNameError("name of a mapping", ours, [*_ROLES, "camera_…"])
        if theirs not in info.features:
            raise UnknownNameError("feature of the dataset", theirs, list(info.features))
    roles: dict[str, str] = {}
    problems = []
    for ours, (usual, sizes) in _ROLES.items():
        shape = tuple(tactile.num_taxels if size < 0 else size for size in sizes)
        name = names.get(ours, usual)
        got = info.features.get(name)
        if got is not None and got.dtype in {"float32", "float64"} and got.numbers() == shape:
            roles[ours] = name
        elif ours == "action" or ours in names:
            said = f"{name!r} is {_describe(got)}, expected float32 {[*shape]}" if got else ""
            problems.append(f"{ours!r}: {said or f'no feature {name!r}'}")
    cameras = _cameras(info, names)
    if HEAD not in cameras:
        problems.append(f"{HEAD!r}: no video feature {layout.IMAGES + HEAD!r}")
    problems += [
        f"{ours!r}: {name!r} is {_describe(info.features[name])}, expected video [h, w, 3]"
        for ours, name in cameras.items()
        if not info.features[name].is_video()
    ]
    if problems:
        has = "; ".join(f"{name!r} {_describe(f)}" for name, f in info.features.items())
        raise InvalidInputError(
            f"LeRobot dataset does not fit: {'; '.join(problems)}. It has: {has}. Name the right "
            "ones in Python: dextouch.bridges.lerobot.import_lerobot(folder, store, "
            "options=ImportOptions(mapping={'camera_head': 'observation.images.top'}))",
            missing=problems,
        )
    return roles | cameras


def _cameras(info: DatasetInfo, names: Mapping[str, str]) -> dict[str, str]:
    """Cameras under our own names, and those given by the mapping."""
    own = {
        name.removeprefix(layout.IMAGES): name
        for name, feature in info.features.items()
        if name.startswith(layout.IMAGES)
        and _CAMERA_NAME.fullmatch(name.removeprefix(layout.IMAGES))
        and feature.dtype == "video"
        and name not in names.values()
    }
    return own | {ours: theirs for ours, theirs in names.items() if ours not in _ROLES}


def _describe(feature: FeatureInfo) -> str:
    return f"{feature.dtype} {list(feature.shape)}"


@dataclass(frozen=True)
class _Content:
    """Streams of an episode with one row per step.

    `numbers` has the kind, unit and values of each, and which steps have one; `cameras` where the
    images are, and their stamps. A stamp that comes twice is one image, the nearest to two steps.
    """

    t_ref_ns: Int64[np.ndarray, " n"]
    numbers: dict[str, tuple[StreamKind, str, np.ndarray, Bool[np.ndarray, " n"]]]
    cameras: dict[str, tuple[VideoSpan, Int64[np.ndarray, " n"]]]
    tactile_layout: TactileLayout


def _content(
    source: LeRobotFolder,
    entry: EpisodeEntry,
    features: Mapping[str, str],
    sidecar: layout.Sidecar | None,
) -> tuple[_Content, AnchorPoses | None]:
    """An episode's numbers, where its videos are, and the poses that its actions are relative to.

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
    content = _Content(t_ns, {}, {}, _tactile_layout(sidecar))
    if "tactile" in features:
        valid = columns.get(layout.VALID, np.ones((entry.length, 2))).astype(bool)
        kpa = columns[features["tactile"]].astype(np.float32)
        for hand, side in enumerate(SIDES):
            # Of the hands that were sensed at any step.
            if (keep := valid[:, hand]).any():
                content.numbers[f"tactile_{side}"] = ("tactile", "kPa", kpa[:, hand], keep)
    everywhere = np.ones(entry.length, dtype=bool)
    for name, actions in (("action", measured), ("action_commanded", commanded)):
        if actions is not None:
            content.numbers[name] = ("robot_state", "action", actions, everywhere)
    for camera, key in features.items():
        if camera in _ROLES:
            continue
        span = source.span(entry, key)
        stamps = _image_stamps(source, key, t_ns, columns.get(layout.IMAGE_DT), where)
        content.cameras[camera] = (span, stamps)
    return content, anchor


def _store(
    store: EpisodeStore, attributes: EpisodeAttributes, content: _Content, images: ImageUnit
) -> None:
    """Write an episode into the store, atomically; `images` is the unit of the cameras."""
    with store.writer(attributes=attributes) as writer:

        def add(name: str, **properties: object) -> None:
            known = {"name": name, "nominal_rate_hz": attributes.model_rate_hz, **properties}
            writer.add_stream(StreamDescriptor.model_validate(known))

        for name, (kind, unit, values, keep) in content.numbers.items():
            more = {}
            if kind == "tactile" and content.tactile_layout != DEXTOUCH_V1:
                more["layout"] = content.tactile_layout
            add(name, kind=kind, shape=values.shape[1:], dtype=str(values.dtype), unit=unit, **more)
            writer.append(name, values=values[keep], t_ref_ns=content.t_ref_ns[keep])
        for name, (span, stamps_ns) in content.cameras.items():
            add(name, kind="image", shape=span.shape, dtype="uint8", unit=images)
            _store_images(writer, name, span, stamps_ns, images)


def _store_images(
    writer: EpisodeWriter, name: str, span: VideoSpan, stamps_ns: np.ndarray, unit: ImageUnit
) -> None:
    """Copy video that is H.264 in the store's groups already; encode everything else again."""
    fresh = np.diff(stamps_ns, prepend=stamps_ns[0] - 1) > 0
    units = read_units(span) if unit == "h264" and fresh.all() else None
    # The store's video is in closed groups of pictures.
    if units and all(is_keyframe(u) == (k % GOP_IMAGES == 0) for k, u in enumerate(units)):
        writer.append(name, values=encoded_values(units), t_ref_ns=stamps_ns)
        return
    images = (image for image, wanted in zip(read_images(span), fresh, strict=True) if wanted)
    stamps_ns = stamps_ns[fresh]
    for start in range(0, len(stamps_ns), BLOCK_IMAGES):
        block = np.stack(list(islice(images, BLOCK_IMAGES)))
        writer.append(name, values=block, t_ref_ns=stamps_ns[start : start + BLOCK_IMAGES])
    # Exhausts the reader, so that a file that is too short is refused.
    for _ in images:
        pass


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
    return source.columns(entry, wanted)


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
    source: LeRobotFolder,
    entry: EpisodeEntry,
    anchor: AnchorPoses | None,
    features: Mapping[str, str],
    options: ImportOptions,
) -> dict[str, object]:
    name = re.sub(r"[^a-z0-9_-]+", "-", source.folder.resolve().name.lower()).strip("-_")
    data_file = source.data_file(entry)
    with disk_errors(f"read {data_file}"), data_file.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    came_from = f"lerobot:{name}/episode-{entry.index:06d}"
    return {
        "episode_id": f"{options.id_prefix}{(name or 'lerobot')[:96]}-{entry.index:06d}",
        "task": (options.task or entry.task or "unknown")[:128],
        "instruction": entry.task[:2000],
        "domain": options.domain,
        "origin": "recorded",
        "model_rate_hz": float(source.info.fps),
        "anchor": StoredAnchor.from_poses(anchor or WORLD),
        "K_head": options.K_head,
        "lineage": (LineageEntry(kind="recording", id=came_from, sha256=digest),),
    }
