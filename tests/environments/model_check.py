"""Predict a chunk with both world models of the package; needs the extra `model` alone.

Run by `make check-environments` with the oldest and the newest torch of the range. What is
predicted must be what the torch of constraints.txt predicts, but for rounding.
"""

import importlib
import sys

import numpy as np
import PIL
import torch
from dextouch_services.world_model.shipped_checkpoints import (
    default_checkpoint,
    paper_form_checkpoint,
)
from dextouch_services.world_model.world import open_world

from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses
from dextouch.schemas import EVERYTHING, Observation, RolloutStart

# Mean level of touch in kPa and mean level of the images, of 16 steps from nothing known.
EXPECTED = {"state.safetensors": (0.0, 103.767), "tiny.safetensors": (0.3915, 106.202)}
# Convolutions may be of bfloat16, by what is faster on the processor.
TOLERANCES = (1e-3, 0.3)


def predicted(world):
    size_px = world.description.image_height_px
    rows, columns = np.mgrid[:size_px, :size_px] / size_px
    image = (255 * np.stack([rows, columns, rows * columns], axis=-1)).astype(np.uint8)
    actions = np.full((16, 67), 0.1)
    for part in POSE_SLICES:
        actions[:, part] = IDENTITY_POSE_9D
    first = Observation(
        first_step=0,
        images=dict.fromkeys(world.description.cameras, image[None]),
        tactile_kpa=np.ones((1, 2, 320), np.float32),
        action_reached=actions[:1],
        reached_is_measured=True,
    )
    K_head = np.array([[size_px, 0, size_px / 2], [0, size_px, size_px / 2], [0, 0, 1.0]])
    start = RolloutStart(
        world.description.tasks[0],
        3,
        "stand the bottle upright",
        observation=first,
        anchor=AnchorPoses(np.eye(4), np.eye(4), np.eye(4)),
        K_head=K_head,
    )
    actions[:, 18:58] += np.linspace(0, 0.05, 16)[:, None]
    found = world.step(world.reset(start).state, actions, seed=0, selector=EVERYTHING).observation
    images = np.concatenate(list(found.images.values()))
    return float(found.tactile_kpa.mean()), float(images.mean())


def main():
    for name in sys.argv[1:]:
        importlib.import_module(name)
    torch.set_num_threads(1)
    for path in (default_checkpoint(), paper_form_checkpoint()):
        got = predicted(open_world(path))
        near = [
            abs(g - e) <= t for g, e, t in zip(got, EXPECTED[path.name], TOLERANCES, strict=True)
        ]
        assert all(near), f"{path.name}: got {got}, expected {EXPECTED[path.name]}"
    print(f"torch {torch.__version__}, pillow {PIL.__version__}: predictions are right")


if __name__ == "__main__":
    main()
