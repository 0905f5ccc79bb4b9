"""A checkpoint of LeRobot's ACT, and what LeRobot's own control loop does with it.

Run in LeRobot's environment: `python reference.py FOLDER`. The weights are random; statistics are
such that leaving out a processor would change every action.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.control_utils import predict_action

CAMERA = "observation.images.camera_head"
TASK = "stand the bottle"
NUM_CHUNKS, CHUNK_STEPS = 6, 4


def make_checkpoint(folder: Path) -> None:
    """Save policy and processors as LeRobot's training does."""
    torch.manual_seed(3)
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (67,)),
            CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (67,))},
        chunk_size=16,
        n_action_steps=8,
        dim_model=32,
        n_heads=2,
        dim_feedforward=64,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=8,
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
    )
    # Actions close to the pose at the start, with valid rotations.
    rest = torch.zeros(67)
    for first in (3, 12, 61):
        rest[first] = rest[first + 4] = 1.0
    stats = {
        "observation.state": {"mean": torch.full((67,), 0.3), "std": torch.full((67,), 0.7)},
        CAMERA: {"mean": torch.full((3, 1, 1), 0.4), "std": torch.full((3, 1, 1), 0.2)},
        "action": {"mean": rest, "std": torch.full((67,), 0.002)},
    }
    parts = [ACTPolicy(config), *make_pre_post_processors(config, dataset_stats=stats)]
    for part in parts:
        part.save_pretrained(folder)


def control_loop(folder: Path, seen: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Actions [chunks * steps, 67] of LeRobot's loop, one observation for each chunk."""
    policy = ACTPolicy.from_pretrained(folder)
    policy.reset()
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    device = torch.device("cpu")
    actions = [
        predict_action(dict(one), policy, device, before, after, use_amp=False, task=TASK)
        for one in seen
        for _ in range(CHUNK_STEPS)
    ]
    return torch.cat(actions).numpy()


if __name__ == "__main__":
    torch.set_num_threads(1)
    out = Path(sys.argv[1])
    make_checkpoint(out)
    rng = np.random.default_rng(5)
    states = rng.normal(size=(NUM_CHUNKS, 67)).astype(np.float32)
    images = rng.integers(0, 256, (NUM_CHUNKS, 64, 64, 3), dtype=np.uint8)
    steps = [{"observation.state": s, CAMERA: i} for s, i in zip(states, images, strict=True)]
    actions = control_loop(out, steps)
    np.savez(out / "expected.npz", states=states, images=images, actions=actions)
