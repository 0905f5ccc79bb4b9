"""Toy demonstrations as episodes of a store."""

from collections.abc import Sequence

import numpy as np

from dextouch.episodes import EpisodeStore
from dextouch.schemas.episodes import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams.samples import StreamDescriptor
from tests.unit.evaluation import toy

GRID_NS = np.round(np.arange(toy.STEPS) * 1e9 / 15).astype(np.int64)


def write(
    store: EpisodeStore,
    item: toy.Demonstration,
    *,
    shown: Sequence[int] = range(toy.STEPS),
    without: Sequence[str] = (),
    **changed: object,
) -> None:
    """A toy demonstration as an episode of the store, with images of some steps."""
    attributes = {
        "episode_id": item.episode_id, "task": item.task, "instruction": item.instruction,
        "domain": "robot", "origin": "twin", "seed": item.seed, "success": item.success,
        "anchor": StoredAnchor.from_poses(toy.ANCHOR), "K_head": matrix_rows(toy.K_HEAD),
    }  # fmt: skip
    pose = {"kind": "robot_state", "dtype": "float64", "unit": "action", "shape": (67,)}
    touch = {"kind": "tactile", "dtype": "float32", "unit": "kPa", "shape": (320,)}
    streams = {
        "action": (item.measured, pose),
        "action_commanded": (item.commanded, pose),
        "camera_head": (
            item.images,
            {"kind": "image", "dtype": "uint8", "unit": "rgb8", "shape": item.images.shape[1:]},
        ),
        "tactile_left": (item.tactile_kpa[:, 0], touch),
        "tactile_right": (item.tactile_kpa[:, 1], touch),
    }
    built = EpisodeAttributes.model_validate(attributes | changed)
    with store.writer(kind="episode", attributes=built) as writer:
        for name in [name for name in streams if name not in without]:
            values, fields = streams[name]
            writer.add_stream(StreamDescriptor(name=name, nominal_rate_hz=15, **fields))
            steps = list(shown) if fields["kind"] == "image" else slice(None)
            writer.append(name, values=values[steps], t_ref_ns=GRID_NS[: len(values)][steps])
