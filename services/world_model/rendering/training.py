"""Training of the renderer on ground-truth states, some with the pose noise of predicted ones."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from dextouch.command_line import ProgressLines
from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from services.networks.optimizer import Budget, OptimizerLoop, update_average
from services.world_model.dynamics.tensor_trees import combined
from services.world_model.network.configuration import RendererConfig
from services.world_model.rendering.inputs import (
    DrawingInputs,
    PreparedScenes,
    Scenes,
    drawing_inputs,
)
from services.world_model.rendering.rasters import SceneStates, object_transforms
from services.world_model.rendering.renderer import RendererNetwork, has_fast_bfloat16
from services.world_model.settings import RendererTraining

_EDGE_WINDOW_PX = 7
# Chosen: half of the pairs begin at the first image of an episode, as rollouts do.
_LATE_START_SHARE = 0.5
# Chosen: rotation noise (rad) on each axis, beside `shake_m` of position noise.
_SHAKE_RAD = 0.05


@dataclass(frozen=True)
class SceneClip:
    """At least two images of one episode at `steps`, and true states; boxes as of `Scenes`."""

    steps: Int64[np.ndarray, " images"]
    images: UInt8[np.ndarray, "images h w 3"]
    states: SceneStates
    K_head: Float64[np.ndarray, "3 3"]
    boxes_m: Float64[np.ndarray, "k 6"]

    def __len__(self) -> int:
        return len(self.steps)


def train_renderer(
    clips: Sequence[SceneClip],
    config: RendererConfig,
    settings: RendererTraining,
    *,
    rng: np.random.Generator,
    title: str = "",
    initial: RendererNetwork | None = None,
) -> tuple[RendererNetwork, float]:
    """Train on pairs of images of one clip: a start image and a target image.

    `rng` draws initial weights (but those of `initial`), pairs and pose noise. With a `title`,
    progress is shown. Returns the averaged network and CPU seconds.

    Raises:
        InvalidInputError: no clips, several sizes of images, or unsupported sides.
    """
    run = RendererRun(clips, config, settings, rng=rng)
    if initial is not None:
        run.network.load_state_dict(initial.state_dict())
    budget = Budget(settings.cpu_budget_s, settings.max_steps)
    lines = ProgressLines(title, has_bar=False)
    averaged = copy.deepcopy(run.network).eval().requires_grad_(requires_grad=False)
    for loss in OptimizerLoop(run.network, settings.options(), budget).run(run.loss):
        weights = averaged.parameters(), run.network.parameters()
        update_average(*weights, decay=settings.ema_decay, num_updates=budget.step - 1)
        if title:
            lines.show(f"{min(budget.share(), 1.0):.0%}  step {budget.step}  loss {loss:.4f}")
    return averaged, budget.cpu_s


class RendererRun:
    """Network of one run, with the random pairs that it is trained on."""

    def __init__(
        self,
        clips: Sequence[SceneClip],
        config: RendererConfig,
        settings: RendererTraining,
        *,
        rng: np.random.Generator,
    ) -> None:
        sizes = {clip.images.shape[1:3] for clip in clips}
        multiple = 2 ** len(config.widths)
        if len(sizes) != 1 or any(side % multiple for size in sizes for side in size):
            raise InvalidInputError(
                f"renderer training: got {len(clips)} clips of image sizes {sorted(sizes)}, "
                f"expected at least one clip and one size whose sides are multiples of {multiple}"
            )
        self._clips = clips
        self._settings = settings
        self._rng = rng
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(2**31)))
            self.network = RendererNetwork(config)
        self._bfloat16 = settings.uses_bfloat16 and has_fast_bfloat16()

    def loss(self) -> Tensor:
        """Loss of a fresh batch."""
        inputs, true = self.batch()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self._bfloat16):
            drawn = self.network(inputs)
        return drawing_loss(drawn, true, self._settings)

    def batch(self) -> tuple[DrawingInputs, Float32[Tensor, "n 3 h w"]]:
        """Inputs of random pairs and the true later images in 0 … 1."""
        starts, laters = self._pairs()
        scenes, later = gather(self._clips, starts), gather(self._clips, laters)
        scenes = replace(scenes, states=self._shaken(scenes.states))
        states = self._shaken(later.states)
        owner = np.arange(len(starts))
        inputs = drawing_inputs(PreparedScenes.of(scenes), states, owner, self.network.config)
        true = torch.from_numpy(np.ascontiguousarray(np.moveaxis(later.images, -1, 1)))
        return inputs, true.float() / 255.0

    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        starts, laters = [], []
        for _ in range(self._settings.batch):
            clip = int(self._rng.integers(len(self._clips)))
            length = len(self._clips[clip])
            is_late = self._rng.random() < _LATE_START_SHARE
            start = int(self._rng.integers(length - 1)) if is_late else 0
            starts.append((clip, start))
            laters.append((clip, int(self._rng.integers(start + 1, length))))
        return np.array(starts), np.array(laters)

    def _shaken(self, states: SceneStates) -> SceneStates:
        """Add pose noise to objects in some states; always draws as many random numbers."""
        settings, shape = self._settings, states.object_present.shape
        is_shaken = self._rng.random(len(states)) < settings.shaken_fraction
        shift = self._rng.normal(size=(*shape, 3)) * settings.shake_m
        turn = self._rng.normal(size=(*shape, 3)) * _SHAKE_RAD
        poses = states.object_poses.copy()
        poses[..., :3] += shift * is_shaken[:, None, None]
        R = rotation_from_vector(turn * is_shaken[:, None, None])
        Ts = object_transforms(states.object_poses)
        poses[..., 3:] = quaternion_from_rotation(R @ Ts[..., :3, :3])
        return replace(states, object_poses=poses)


def drawing_loss(
    drawn: Float32[Tensor, "n 3 h w"], true: Float32[Tensor, "n 3 h w"], settings: RendererTraining
) -> Float32[Tensor, ""]:
    """Mean absolute error of colours (0 … 1), which alone blur, of gradients and edges."""
    error = drawn - true
    across = (error[..., 1:] - error[..., :-1]).abs().mean()
    down = (error[..., 1:, :] - error[..., :-1, :]).abs().mean()
    sharpness = (_edges(drawn) - _edges(true)).abs().mean()
    return (
        error.abs().mean()
        + settings.gradient_weight * (across + down)
        + settings.sharpness_weight * sharpness
    )


def _edges(images: Float32[Tensor, "n 3 h w"]) -> Float32[Tensor, "n 3 rows columns"]:
    """Mean absolute Laplacian (five points) in windows of 7 pixels."""
    centre = images[..., 1:-1, 1:-1]
    across = images[..., 1:-1, 2:] + images[..., 1:-1, :-2]
    down = images[..., 2:, 1:-1] + images[..., :-2, 1:-1]
    side = min(_EDGE_WINDOW_PX, *centre.shape[-2:])
    return functional.avg_pool2d((across + down - 4.0 * centre).abs(), side, stride=3)


def gather(clips: Sequence[SceneClip], rows: Int64[np.ndarray, "b 2"]) -> Scenes:
    """Images and states at rows (clip, image), as scenes; missing object slots are empty."""
    num_slots = max(len(clips[clip].boxes_m) for clip, _ in rows)
    boxes_m = np.zeros((len(rows), num_slots, 6))
    for row, (clip, _) in enumerate(rows):
        boxes_m[row, : len(clips[clip].boxes_m)] = clips[clip].boxes_m
    images = np.stack([clips[clip].images[image] for clip, image in rows])
    states = [clips[clip].states.take(slice(i, i + 1)).padded(num_slots) for clip, i in rows]
    K_head = np.stack([clips[clip].K_head for clip, _ in rows])
    return Scenes(images, K_head, combined(states, np.concatenate), boxes_m)
