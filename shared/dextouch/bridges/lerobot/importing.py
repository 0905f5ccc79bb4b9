"""Import of LeRobotDataset v3 folders as episodes of the store."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from dextouch.bridges.lerobot.content import content_of
from dextouch.bridges.lerobot.mapping import FeatureMap, map_features
from dextouch.bridges.lerobot.rows import WORLD
from dextouch.bridges.lerobot.sidecar import Sidecar, read_sidecar
from dextouch.bridges.lerobot.source import EpisodeEntry, LeRobotFolder
from dextouch.bridges.model_grid import ImageUnit, store_episode
from dextouch.episodes import EpisodeStore, disk_errors
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import Domain, EpisodeAttributes, LineageEntry, Matrix, StoredAnchor


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import: information that the dataset itself lacks.

    `mapping`: our name → the dataset's feature. `id_prefix`: put before every id (needed when ids
    exist already); `images`: the unit that images are stored in. Only for datasets of other origin:
    `K_head` in pixels, `domain` and `task` (without it the dataset's own text).
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

    Each episode appears complete or not at all; after an error, earlier episodes remain.

    Args:
        folder: root of the dataset; nothing outside it is read.
        store: destination.
        options: feature names, ids, image unit, and values missing in foreign datasets.

    Raises:
        NotFoundError: a file is missing.
        InvalidInputError: another version of the format, or features that do not fit.
        CorruptDataError: damaged or truncated files, or paths that lead out of the folder.
        LimitExceededError: larger than the limits of this reader.
        ConflictError: an id exists already.
    """
    source = LeRobotFolder(folder)
    features = map_features(source.info, options.mapping)
    ids: list[str] = []
    for entry in source.episodes:
        sidecar = read_sidecar(folder, entry.index)
        episode, anchor = content_of(source, entry, features, sidecar)
        if sidecar is None:
            attributes = _foreign_attributes(source, entry, anchor, features, options)
        else:
            attributes = _known_attributes(source, anchor, sidecar, options)
        if store.exists(attributes.episode_id):
            raise ConflictError(
                f"episode {attributes.episode_id!r} exists already; give another id_prefix"
            )
        store_episode(store, attributes, episode, images=options.images)
        ids.append(attributes.episode_id)
    return ids


def _known_attributes(
    source: LeRobotFolder, anchor: AnchorPoses | None, sidecar: Sidecar, options: ImportOptions
) -> EpisodeAttributes:
    """The exported attributes, with the anchor of the first frame and the source in the lineage."""
    known = sidecar.attributes
    came_from = LineageEntry(kind="episode", id=known.episode_id, sha256=sidecar.content_sha256)
    changes = {
        "episode_id": f"{options.id_prefix}{known.episode_id}",
        "model_rate_hz": float(source.info.fps),
        "lineage": (*known.lineage, came_from),
        "anchor": known.anchor if anchor is None else StoredAnchor.from_poses(anchor),
        "streams": (),
    }
    return _checked(known.model_dump() | changes)


def _foreign_attributes(
    source: LeRobotFolder,
    entry: EpisodeEntry,
    anchor: AnchorPoses | None,
    features: FeatureMap,
    options: ImportOptions,
) -> EpisodeAttributes:
    if options.K_head is None:
        raise InvalidInputError(
            f"{source.folder}: has no information about its head camera "
            f"({features.cameras['camera_head']!r}); give K_head= in pixels"
        )
    name = re.sub(r"[^a-z0-9_-]+", "-", source.folder.resolve().name.lower()).strip("-_")
    data_file = source.data_file(entry)
    with disk_errors(f"read {data_file}"), data_file.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return _checked(
        {
            "episode_id": f"{options.id_prefix}{(name or 'lerobot')[:96]}-{entry.index:06d}",
            "task": (options.task or entry.task or "unknown")[:128],
            "instruction": entry.task[:2000],
            "domain": options.domain,
            "origin": "recorded",
            "model_rate_hz": float(source.info.fps),
            "anchor": StoredAnchor.from_poses(anchor or WORLD),
            "K_head": options.K_head,
            "lineage": (
                LineageEntry(
                    kind="recording", id=f"lerobot:{name}/episode-{entry.index:06d}", sha256=digest
                ),
            ),
        }
    )


def _checked(fields: Mapping[str, object]) -> EpisodeAttributes:
    try:
        return EpisodeAttributes.model_validate(fields)
    except ValidationError as error:
        raise InvalidInputError(
            f"import from LeRobot: the options make no episode ({error})"
        ) from error
