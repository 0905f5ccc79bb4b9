"""Video latents of training images on disk, so that Wan2.2's autoencoder sees each window once."""

import hashlib
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import google_crc32c
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from dextouch.episodes import disk_errors
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    StorageError,
    StorageFullError,
    UnavailableError,
)
from services.world_model import checkpoints
from services.world_model.network.codecs import Latents
from services.world_model.network.configuration import FRAMES_PER_LATENT, WanFiles, num_latents
from services.world_model.network.model import JointWorldModel
from services.world_model.paper_settings import TrainSettings
from services.world_model.pretrained_video import initial_codec
from services.world_model.training.episode_sets import load_split
from services.world_model.training.joint_dataset import (
    TrainingEpisode,
    WindowPosition,
    window_starts,
)

_SCHEMA: Final = (
    "CREATE TABLE IF NOT EXISTS latents (key BLOB PRIMARY KEY, crc32c INTEGER, latent BLOB)"
)
# Chosen: what SQLite adds to each latent is below this.
_OVERHEAD_BYTES: Final = 256
_Images = UInt8[Tensor, "n time px px 3"]


class LatentCache:
    """Latents by the images that they depend on, in a SQLite file, which processes may share.

    The encoder is causal: latent i depends on the images 0 … 4i alone. It is found by the SHA-256
    of these and of the encoder's weights, so that other images or weights find nothing. Unless it
    `adds`, latents that are not there are computed and not kept.

    Raises:
        CorruptDataError: another file, or a damaged one.
        StorageError: it cannot be opened or written; StorageFullError if no space is left.
        UnavailableError: other processes write to it all the time.
    """

    def __init__(
        self, path: Path, weights: Mapping[str, Tensor], channels: int, *, adds: bool = True
    ) -> None:
        self._path, self._channels, self._adds = path, channels, adds
        self._encoder = hashlib.sha256()
        for name, tensor in sorted(weights.items()):
            self._encoder.update(name.encode())
            self._encoder.update(
                tensor.cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes()
            )
        with disk_errors(f"make the folder of {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
        with self._errors():
            # Written by several processes of a training, one after the other.
            self._connection = sqlite3.connect(path, timeout=60.0)
            self._connection.execute(_SCHEMA)
            # Of the file: while another process does so, too, this one has nothing to do.
            with suppress(sqlite3.OperationalError):
                self._connection.execute("PRAGMA journal_mode = WAL")

    def of(self, images: _Images, encode: Callable[[_Images], Latents]) -> Latents:
        """Latents of windows of images; those that are not there come from `encode`, one by one."""
        found = []
        for window in torch.split(images, 1):
            keys = self._keys(window[0].cpu().numpy())
            latents = self._read(keys)
            if latents is None:
                latents = encode(window)[0].cpu()
                if self._adds:
                    self._write(keys, latents)
            found.append(latents)
        return torch.stack(found).to(images.device)

    def _keys(self, window: UInt8[np.ndarray, "time px px 3"]) -> list[bytes]:
        digest = self._encoder.copy()
        digest.update(str(window.shape[1]).encode())
        parts = np.split(window, range(1, len(window), FRAMES_PER_LATENT))
        keys = []
        for part in parts:
            digest.update(part.tobytes())
            keys.append(digest.digest())
        return keys

    def _read(self, keys: list[bytes]) -> Tensor | None:
        asked = ", ".join("?" * len(keys))
        select = f"SELECT key, crc32c, latent FROM latents WHERE key IN ({asked})"  # noqa: S608
        with self._errors():
            rows = self._connection.execute(select, keys).fetchall()
        known: dict[bytes, Tensor] = {}
        for key, crc32c, latent in rows:
            if google_crc32c.value(latent) != crc32c:
                raise CorruptDataError(
                    f"latents in {self._path}: one does not match its checksum; remove the file, "
                    "which is made again"
                )
            values = np.frombuffer(bytearray(latent), dtype="<f4")
            known[key] = torch.from_numpy(values).view(-1, self._channels)
        return torch.stack([known[key] for key in keys]) if len(known) == len(keys) else None

    def _write(self, keys: list[bytes], latents: Tensor) -> None:
        values = [one.numpy().astype("<f4").tobytes() for one in latents]
        rows = [(k, google_crc32c.value(v), v) for k, v in zip(keys, values, strict=True)]
        with self._errors(), self._connection as connection:
            connection.executemany("INSERT OR IGNORE INTO latents VALUES (?, ?, ?)", rows)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            code, where = getattr(error, "sqlite_errorcode", 0) & 0xFF, f"latents in {self._path}"
            if code == sqlite3.SQLITE_FULL:
                raise StorageFullError(
                    f"{where}: no space left; free some, or use another disk"
                ) from error
            if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
                raise CorruptDataError(
                    f"{where}: {error}; remove the file, which is made again, or name another one "
                    "with --wan.latent-cache"
                ) from error
            if code == sqlite3.SQLITE_BUSY:
                raise UnavailableError(
                    f"{where}: other processes are writing for a minute; try again"
                ) from error
            raise StorageError(
                f"{where}: {error}; name a file on a local disk that can be written"
            ) from error


def use_latent_cache(model: JointWorldModel, files: WanFiles, *, adds: bool = True) -> None:
    """Let a model find the latents of its images in the cache that is named, if one is.

    Raises:
        InvalidInputError: a model whose own linear codec is faster than a cache.
        StorageError, UnavailableError: as `LatentCache`.
    """
    if files.latent_cache is None:
        return
    if model.config.wan is None:
        raise InvalidInputError(
            f"--wan.latent-cache: got {files.latent_cache} with video_expert "
            f"{model.config.video_expert}, expected wan; leave it out"
        )
    weights, channels = model.codec.state_dict(), model.config.video_channels
    model.latent_cache = LatentCache(files.latent_cache, weights, channels, adds=adds).of


@dataclass(frozen=True)
class CachedWindows:
    """What a cache was filled with."""

    path: Path
    num_episodes: int
    num_windows: int
    num_instructions: int


@torch.no_grad()
def fill_latent_cache(
    settings: TrainSettings,
    track: Callable[[Sequence[WindowPosition]], Iterable[WindowPosition]] = iter,
) -> CachedWindows:
    """Encode the longest window at each step of the episodes that a training would use.

    What is there already is not computed again. Instructions are encoded, too, if a folder is named
    for them. `track` shows progress.

    Raises:
        InvalidInputError: no cache is named, or a model without Wan2.2; else as `train`.
        LimitExceededError: the disk has less space than all latents need.
    """
    config, path = settings.network, settings.wan.latent_cache
    if path is None:
        raise InvalidInputError(
            "latents: got no file to keep them in; name one with --wan.latent-cache"
        )
    if settings.init is not None:
        model = checkpoints.read_checkpoint(settings.init).model
        if model.text_features is not None:
            model.text_features.use(settings.wan.folder, settings.wan.text_cache)
    else:
        model = initial_codec(config, settings.wan)
    use_latent_cache(model, settings.wan)
    model.codec.to(settings.device)
    trained, _ = load_split(settings)
    places = _longest_windows(trained, config.max_steps)
    num_windows, num_views = len(places), 1 + len(config.further_views)
    latent_bytes = 4 * config.tokens_per_latent * config.video_channels + _OVERHEAD_BYTES
    needed = num_windows * num_views * num_latents(config.max_steps) * latent_bytes
    free = shutil.disk_usage(path.parent).free + path.stat().st_size
    if needed > free:
        raise LimitExceededError(
            f"latents in {path}: {num_windows} windows need {needed / 1e9:.1f} GB, expected at "
            f"most the {free / 1e9:.1f} GB that are free; use another disk, or fewer episodes"
        )
    one_each = {place.episode_index: place for place in places}
    instructions = {trained[i].cut(place).request.instruction for i, place in one_each.items()}
    if model.text_features is not None and settings.wan.text_cache is not None:
        model.text_features.stack(sorted(instructions))
    for place in track(places):
        window = trained[place.episode_index].cut(place)
        views = [window.images, *([] if window.further is None else window.further)]
        model.encode_images(torch.from_numpy(np.stack(views)).to(settings.device))
    return CachedWindows(path, len(trained), num_windows, len(instructions))


def _longest_windows(episodes: Sequence[TrainingEpisode], max_steps: int) -> list[WindowPosition]:
    """The longest window of 1 + 4k steps from each step; shorter ones are its beginning."""
    found: dict[tuple[int, int], WindowPosition] = {}
    for num_steps in range(1 + FRAMES_PER_LATENT, max_steps + 1, FRAMES_PER_LATENT):
        for index, episode in enumerate(episodes):
            for start in window_starts(episode, num_steps).tolist():
                found[index, start] = WindowPosition(index, start, num_steps)
    return list(found.values())
