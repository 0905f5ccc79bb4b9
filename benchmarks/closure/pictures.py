"""Contact sheet of a human take and its replays, one row each."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import UInt8

from benchmarks.closure.methods import Method, retarget_take, robot_trajectory
from benchmarks.closure.replay import human_take, replay
from dextouch.geometry import nearest_index
from dextouch.images import encode_jpeg
from dextouch.streams import HEAD_CAMERA
from services.twin.episodes import TruthStream

# Approach, grasp, lift, carry, set down, release, withdraw.
_AT_S: Final = (0.4, 1.0, 1.4, 1.9, 2.5, 3.1, 3.6, 4.2, 5.3)
_GAP_PX: Final = 4


def contact_sheet(rows: Sequence[Mapping[str, TruthStream]]) -> UInt8[np.ndarray, "h w 3"]:
    """Images of the head camera at the same moments of several takes, one take a row."""
    at_ns = np.array([round(at_s * 1e9) for at_s in _AT_S], dtype=np.int64)
    bands = []
    for streams in rows:
        stream = streams[HEAD_CAMERA]
        images = stream.values[nearest_index(stream.t_ref_ns, at_ns)]
        bands.append(np.concatenate(list(images), axis=1))
    gap = np.full((_GAP_PX, bands[0].shape[1], 3), 255, dtype=np.uint8)
    parts = [part for band in bands for part in (band, gap)]
    return np.concatenate(parts[:-1], axis=0)


def write_sheet(task: str, seed: int, methods: Sequence[Method], path: Path) -> list[bool]:
    """Play one take by each method and write its sheet, the human's take on top.

    Returns:
        Whether each method succeeded.
    """
    episode = human_take(task, seed, images=(HEAD_CAMERA,))
    take = retarget_take(episode)
    replays = [
        replay(task, take, robot_trajectory(take, method), images=(HEAD_CAMERA,))
        for method in methods
    ]
    sheet = contact_sheet([episode.streams, *(played.streams for played in replays)])
    path.write_bytes(encode_jpeg(sheet, quality=80))
    return [played.succeeded for played in replays]
