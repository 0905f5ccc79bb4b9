"""An existing LeRobot dataset that episodes are appended to: what they must fit, and its files."""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.layout import QUANTILES, Features, Statistics
from dextouch.bridges.lerobot.source import LeRobotFolder
from dextouch.episodes import disk_errors
from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError

# Files that are written anew; all others are shared by the old and the new dataset.
_REWRITTEN = (layout.INFO_FILE, layout.STATS_FILE, layout.TASKS_FILE)
_VIDEO_FIELDS = ("video.height", "video.width", "video.codec", "video.pix_fmt", "video.fps")
_STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)


@dataclass(frozen=True)
class ExistingDataset:
    """A dataset on disk, and where its numbering ends.

    `content_sha256` are the hashes of the episodes of ours that it has.
    """

    source: LeRobotFolder
    info: dict[str, Any]
    statistics: dict[str, Statistics]
    content_sha256: frozenset[str]

    @staticmethod
    def read(folder: Path) -> "ExistingDataset":
        """Read the descriptions of a dataset.

        Raises InvalidInputError for one that cannot be appended to; as `LeRobotFolder` for one that
        cannot be read.
        """
        source = LeRobotFolder(folder)
        info = json.loads((folder / layout.INFO_FILE).read_text("utf-8-sig"))
        expected = {
            "codebase_version": layout.CODEBASE_VERSION,
            "data_path": layout.DATA_PATH,
            "chunks_size": layout.CHUNK_FILES,
            "splits": {"train": f"0:{len(source.episodes)}"},
            "total_episodes": max((one.index for one in source.episodes), default=-1) + 1,
        }
        for key, value in expected.items():
            if info.get(key) != value:
                raise InvalidInputError(
                    f"{folder}: cannot be appended to: info.json has {key} {info.get(key)!r}, "
                    f"expected {value!r}; export into a new folder"
                )
        sidecars = [source.sidecar(entry) for entry in source.episodes]
        known = frozenset(one.content_sha256 for one in sidecars if one is not None)
        return ExistingDataset(source, info, _read_statistics(folder, info["features"]), known)

    @property
    def num_frames(self) -> int:
        """Frames of all its episodes."""
        return sum(entry.length for entry in self.source.episodes)

    def next_file(self, template: str, **values: str) -> int:
        """Number of the first file of a kind that it does not have."""
        parts = template.format(chunk_index=0, file_index=0, **values).split("/")
        above = self.source.folder.joinpath(*parts[:-2])
        pattern = f"chunk-*/file-*{Path(parts[-1]).suffix}"
        numbers = [
            int(path.parent.name.removeprefix("chunk-")) * layout.CHUNK_FILES
            + int(path.stem.removeprefix("file-"))
            for path in above.glob(pattern)
            if path.stem.removeprefix("file-").isdecimal()
            and path.parent.name.removeprefix("chunk-").isdecimal()
        ]
        return max(numbers, default=-1) + 1

    def check_fits(self, features: Features, fps: int) -> None:
        """Raise InvalidInputError where new episodes have other features, rate or codec."""
        problems = [] if self.info["fps"] == fps else [f"fps {self.info['fps']}, not {fps}"]
        theirs = self.info["features"]
        for key in sorted({*theirs, *features}):
            if key not in theirs or key not in features:
                what = "the new episodes have" if key in features else "only the dataset has"
                problems.append(f"{key!r}: {what} it")
                continue
            old, new = _compared(theirs[key]), _compared(features[key])
            problems += [
                f"{key!r}: {field} {old[field]!r}, not {new[field]!r}"
                for field in old
                if old[field] != new[field]
            ]
        if problems:
            raise InvalidInputError(
                f"{self.source.folder}: the episodes cannot be appended, the dataset has "
                f"{'; '.join(problems)}; export with the dataset's options or into a new folder",
                problems=problems,
            )

    def check_columns(self, columns: Sequence[str]) -> None:
        """Raise InvalidInputError where the new table of episodes would have other columns."""
        first = min((self.source.folder / "meta" / "episodes").glob("*/*.parquet"))
        odd = {*pq.read_schema(first).names} ^ {*columns}
        if odd:
            raise InvalidInputError(
                f"{first}: cannot be appended to: columns {sorted(odd)} are not in both the "
                "dataset and the new episodes; export into a new folder"
            )

    def link_into(self, folder: Path) -> None:
        """Put all files that stay into a new folder, without a copy where the disk can."""
        root = self.source.folder
        with disk_errors(f"link the files of {root}"):
            for path in root.rglob("*"):
                name = path.relative_to(root)
                if path.is_symlink():
                    raise CorruptDataError(f"{path}: is a link; a dataset has files of its own")
                if path.is_dir() or name.as_posix() in _REWRITTEN:
                    continue
                target = folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(path, target)
                except OSError:
                    shutil.copy2(path, target)

    def check_unchanged(self) -> None:
        """Raise ConflictError if another process has changed the dataset meanwhile."""
        now = json.loads((self.source.folder / layout.INFO_FILE).read_text("utf-8-sig"))
        if now != self.info:
            raise ConflictError(
                f"{self.source.folder}: was changed while episodes were appended; append again"
            )


def _compared(feature: Mapping[str, Any]) -> dict[str, Any]:
    fields = {key: feature.get(key) for key in ("dtype", "shape", "names")}
    about = feature.get("info") or {}
    if feature.get("dtype") == "video":
        fields |= {key: about.get(key) for key in _VIDEO_FIELDS}
    return fields


def _read_statistics(folder: Path, features: Features) -> dict[str, Statistics]:
    path = folder / layout.STATS_FILE
    try:
        plain = json.loads(path.read_text("utf-8-sig"))
        found = {
            name: {kind: np.array(plain[name][kind]) for kind in _STATISTICS} for name in features
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CorruptDataError(
            f"{path}: lacks statistics of the dataset's features ({error!r}); recompute them with "
            "lerobot, or export into a new folder"
        ) from error
    return found
