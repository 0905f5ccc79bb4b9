"""Dataset card (README.md) of a LeRobot export, as the Hugging Face Hub reads it."""

import json
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.source import LeRobotFolder
from dextouch.errors import InvalidInputError

# A card with this line was written here and is written anew; others are the user's own.
GENERATED: Final = "<!-- Written by dextouch export; without this line it is kept as it is. -->"
_LICENSE = re.compile(r"[a-z0-9][a-z0-9.+-]{0,63}")
_SAID_LICENSE = re.compile(r"^license: (\S+)$", re.MULTILINE)
MAX_LISTED_TASKS: Final = 50
# Of the Hub, by number of rows.
_SIZES = ((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M"))
_LARGE = "1M<n<10M"


def check_license(name: str | None) -> None:
    """Raise InvalidInputError for a name that is no identifier of a licence on the Hub."""
    if name is not None and not _LICENSE.fullmatch(name):
        raise InvalidInputError(
            f"license: got {name!r}, expected an identifier of the Hub such as cc-by-4.0, "
            "apache-2.0 or other"
        )


def write_card(folder: Path, *, repo_id: str, license_name: str | None) -> None:
    """Write the card of a dataset from what the dataset holds.

    A card that was changed by others stays; one of ours keeps its licence if no other is given.
    Without a licence the card says so, since the Hub shows none then.
    """
    path = folder / layout.CARD_FILE
    before = path.read_text() if path.is_file() else GENERATED
    if GENERATED not in before:
        return
    said = _SAID_LICENSE.search(before)
    license_name = license_name or (said[1] if said else None)
    path.unlink(missing_ok=True)
    path.write_text(card_text(LeRobotFolder(folder), repo_id=repo_id, license_name=license_name))


def card_text(source: LeRobotFolder, *, repo_id: str, license_name: str | None) -> str:
    """Text of a card: front matter in YAML, then what the dataset holds and how to load it."""
    frames = sum(entry.length for entry in source.episodes)
    size = next((name for limit, name in _SIZES if frames < limit), _LARGE)
    header = [
        *([f"license: {license_name}"] if license_name else []),
        "task_categories:\n- robotics",
        "tags:\n- LeRobot\n- tactile\n- bimanual\n- dextouch",
        f"size_categories:\n- {size}",
        "configs:\n- config_name: default\n  data_files: data/*/*.parquet",
    ]
    parts = [
        "---\n" + "\n".join(header) + "\n---",
        GENERATED,
        f"# {repo_id}",
        f"A [LeRobotDataset {source.info.codebase_version}]"
        "(https://huggingface.co/docs/lerobot/lerobot-dataset-v3) exported from DexTouch: hand "
        "poses, joints, touch and images on one grid of frames. What LeRobot has no field for is "
        "in `meta/dextouch`.",
        _contents(source, frames),
        _tasks(source),
        _features(source),
        "## Loading\n\n```python\nfrom lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
        f"dataset = LeRobotDataset({json.dumps(repo_id)})  # or with root=FOLDER\n"
        'print(dataset[0]["observation.state"].shape)\n```',
        "## License\n\n" + (license_name or "The publisher has named no licence."),
    ]
    return "\n\n".join(parts) + "\n"


def _contents(source: LeRobotFolder, frames: int) -> str:
    info = source.info
    sidecars = [source.sidecar(entry) for entry in source.episodes]
    known = [one.attributes for one in sidecars if one is not None]
    rows = {
        "episodes": f"{len(source.episodes)}",
        "frames": f"{frames}, {info.fps:g} a second",
        "duration": f"{frames / info.fps / 3600:.3f} h",
        "size": f"{_bytes(source.folder) / 1e6:.1f} MB",
        "cameras": ", ".join(
            f"{key.removeprefix(layout.IMAGES)} {feature.shape[1]} x {feature.shape[0]}"
            for key, feature in info.features.items()
            if feature.is_camera()
        ),
        "acted by": _counted(one.domain for one in known),
        "origin": _counted(one.origin for one in known),
        "success": _counted(
            {True: "yes", False: "no", None: "not judged"}[one.success] for one in known
        ),
    }
    return "## Contents\n\n" + _table(("", ""), [[k, v] for k, v in rows.items() if v])


def _tasks(source: LeRobotFolder) -> str:
    counts: Counter[str] = Counter()
    frames: Counter[str] = Counter()
    for entry in source.episodes:
        counts[entry.task] += 1
        frames[entry.task] += entry.length
    rows = [
        [task, f"{number}", f"{frames[task] / source.info.fps / 60:.1f}"]
        for task, number in counts.most_common(MAX_LISTED_TASKS)
    ]
    left = len(counts) - len(rows)
    more = f"\n\nand {left} more" if left > 0 else ""
    return "## Tasks\n\n" + _table(("task", "episodes", "minutes"), rows) + more


def _features(source: LeRobotFolder) -> str:
    rows = [
        [
            f"`{key}`",
            feature.dtype,
            " x ".join(map(str, feature.shape)),
            layout.MEANING.get(key, ""),
        ]
        for key, feature in source.info.features.items()
    ]
    return "## Features\n\n" + _table(("feature", "type", "shape", "content"), rows)


def _counted(values: Iterable[str]) -> str:
    return ", ".join(f"{value} {number}" for value, number in Counter(values).most_common())


def _bytes(folder: Path) -> int:
    parts = (folder / name for name in ("data", "videos"))
    return sum(path.stat().st_size for part in parts for path in part.rglob("*") if path.is_file())


def _table(header: tuple[str, ...], rows: list[list[str]]) -> str:
    lines = [list(header), ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)


def _cell(text: str) -> str:
    """Text in one cell of a table: in one line, and free of Markdown's own characters."""
    return re.sub(r"([|<\\])", r"\\\1", " ".join(text.split()))
