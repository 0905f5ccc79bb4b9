"""One JSON file per episode with the DexTouch attributes that LeRobot has no field for."""

import json
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, ValidationError

from dextouch.bridges.lerobot.layout import SIDECAR_PATH, confined, fill_path
from dextouch.bridges.lerobot.rows import Grid
from dextouch.episodes import disk_errors
from dextouch.errors import CorruptDataError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ActionKind, EpisodeAttributes

MAX_SIDECAR_BYTES: Final = 1 << 22


class Sidecar(FrozenModel):
    """An episode's attributes, its content hash, and how its frames were made.

    `cameras` says whether a camera's video was `remuxed` (bytes unchanged) or `encoded` again.
    """

    sidecar_version: Literal[1] = 1
    episode_index: int = Field(ge=0)
    content_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    grid: Grid
    action_kind: ActionKind
    cameras: dict[str, Literal["remuxed", "encoded"]]
    attributes: EpisodeAttributes


def write_sidecar(folder: Path, sidecar: Sidecar) -> None:
    """Write an episode's sidecar file.

    Raises:
        StorageError: the write failed.
    """
    path = folder / fill_path(SIDECAR_PATH, episode_index=sidecar.episode_index)
    with disk_errors(f"write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(sidecar.model_dump(mode="json"), indent=2) + "\n")


def read_sidecar(folder: Path, episode_index: int) -> Sidecar | None:
    """An episode's sidecar; None where the dataset was not written by DexTouch.

    Raises:
        CorruptDataError: an invalid sidecar file.
    """
    path = confined(folder, fill_path(SIDECAR_PATH, episode_index=episode_index))
    if not path.is_file():
        return None
    with disk_errors(f"read {path}"):
        if path.stat().st_size > MAX_SIDECAR_BYTES:
            raise CorruptDataError(f"{path}: is larger than {MAX_SIDECAR_BYTES} bytes")
        data = path.read_bytes()
    try:
        sidecar = Sidecar.model_validate_json(data)
    except ValidationError as error:
        raise CorruptDataError(
            f"{path}: is not a description of an episode ({error}); remove it to import the frames "
            "as a dataset of other origin"
        ) from error
    if sidecar.episode_index != episode_index:
        raise CorruptDataError(
            f"{path}: got episode {sidecar.episode_index}, expected {episode_index}"
        )
    return sidecar
