"""Rollouts as episodes on the model grid."""

from collections.abc import Sequence

import numpy as np

from dextouch.episodes.store import EpisodeStore
from dextouch.schemas import EpisodeAttributes, Observation
from dextouch.streams import HEAD_CAMERA, StreamDescriptor, StreamKind
from dextouch.tactile.layout import SIDES, TactileLayout


def write_rollout(
    store: EpisodeStore,
    attributes: EpisodeAttributes,
    observations: Sequence[Observation],
    commanded: np.ndarray,
    *,
    layout: TactileLayout | None = None,
) -> None:
    """Write a rollout as an episode on the model grid.

    Images are stored for the steps that have them. Object poses, if the world returned them for
    every chunk, are the stream `object_poses`, from step 1 on: the first observation may be real,
    without known poses.

    Args:
        store: destination.
        attributes: without `streams`.
        observations: of step 0 and of every chunk; at least one has images of the head camera.
        commanded: [T, 67] actions, row 0 the poses of step 0.
        layout: of the taxels, None of `dextouch_v1`.
    """
    rate_hz = attributes.model_rate_hz
    tactile = np.concatenate([observation.tactile_kpa for observation in observations])
    with_images = [observation for observation in observations if HEAD_CAMERA in observation.images]
    images = np.concatenate([observation.images[HEAD_CAMERA] for observation in with_images])
    shown_steps = np.concatenate([one.first_step + np.arange(len(one)) for one in with_images])
    reached = np.concatenate([observation.action_reached for observation in observations])
    t_ref_ns = np.round(np.arange(len(tactile)) * 1e9 / rate_hz).astype(np.int64)
    streams: list[tuple[str, StreamKind, str, np.ndarray]] = [
        (HEAD_CAMERA, "image", "rgb8", images),
        ("action", "robot_state", "action_m_rad", reached),
        ("action_commanded", "robot_state", "action_m_rad", np.asarray(commanded)),
    ]
    for index, side in enumerate(SIDES):
        streams.append((f"tactile_{side}", "tactile", "kPa", tactile[:, index]))
    poses = [one.object_poses for one in observations[1:] if one.object_poses is not None]
    if poses and len(poses) == len(observations) - 1:
        values = np.concatenate(poses).astype(np.float64)
        streams.append(("object_poses", "pose", "pose_m_wxyz", values))
    with store.writer(kind="episode", attributes=attributes) as writer:
        for name, kind, unit, values in streams:
            writer.add_stream(
                StreamDescriptor.model_validate(
                    {
                        "name": name,
                        "kind": kind,
                        "shape": values.shape[1:],
                        "dtype": values.dtype.name,
                        "unit": unit,
                        "nominal_rate_hz": rate_hz,
                        "frame": "world" if kind == "pose" else None,
                        "layout": layout if kind == "tactile" else None,
                    }
                )
            )
            stamps_ns = t_ref_ns[shown_steps] if name == HEAD_CAMERA else t_ref_ns[-len(values) :]
            writer.append(name, values=values, t_ref_ns=stamps_ns)
