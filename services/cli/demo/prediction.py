"""Prediction errors of a world on held-out episodes, beside simple baselines.

Only the `World` interface is used, so that all kinds of world models are measured alike: over whole
open-loop rollouts, from the first observed step to the last.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.episodes import EpisodeReader
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import CAMERA_HEAD, poses_from_actions
from dextouch.metrics import image as image_metrics
from dextouch.metrics import tactile as tactile_metrics
from dextouch.schemas import Observation, ReturnSelector, RolloutStart
from dextouch.worlds import World
from services.evaluation.camera_warp import warp_over_table
from services.evaluation.reporting import PredictionPicture

CAMERA: Final = "camera_head"
CHUNK_STEPS: Final = 16
_NO_IMAGE = ReturnSelector(cameras=())
_LAST_STEP = ReturnSelector(cameras=(CAMERA,), steps="last")


@dataclass(frozen=True)
class PredictionResult:
    """Figures for `report.json`, and one rollout per task as a picture."""

    figures: dict[str, Any]
    pictures: tuple[PredictionPicture, ...]


@dataclass(frozen=True)
class Future:
    """Images at the ends of chunks, and the touch of every step after the first."""

    images: UInt8[np.ndarray, "chunks h w 3"]
    tactile_kpa: Float32[np.ndarray, "steps 2 320"]


@dataclass(frozen=True)
class Scene:
    """Start of an episode, its commanded actions, and the true future."""

    episode_id: str
    start: RolloutStart
    actions: Float64[np.ndarray, "steps 67"]
    truth: Future
    model_rate_hz: float


def measure_prediction(world: World[Any], scenes: Sequence[Scene]) -> PredictionResult:
    """Errors over whole rollouts of scenes that the world was not trained on.

    Returns:
        `psnr` (dB, mean over the images at the ends of chunks), `tactile_mse` (kPa²) and
        `contact_f1`, each also for the baselines named by a suffix, and `num_rollouts`.

        - _copy repeats the first step; tactile_mse_zero predicts no touch.
        - psnr_warp is the first image, warped by the known camera motion over the table.
        - _other_take is the world given the actions of another held-out scene of the same task.
        - _hold is the world given actions in which nothing moves; in _hands_still the head moves.

    Raises:
        InvalidInputError: no scene.
    """
    if not scenes:
        raise InvalidInputError("prediction: got no scene, expected at least one")
    imagined = [imagine(world, scene, scene.actions) for scene in scenes]
    figures = _figures(imagined, scenes, "")
    figures |= _figures([_copy(scene) for scene in scenes], scenes, "_copy")
    for suffix, head_moves in (("_hold", False), ("_hands_still", True)):
        still = [_still(scene.actions, head_moves=head_moves) for scene in scenes]
        futures = [imagine(world, s, rows) for s, rows in zip(scenes, still, strict=True)]
        figures |= _figures(futures, scenes, suffix)
    others = [(scene, other) for scene in scenes if (other := _other(scene, scenes)) is not None]
    if others:
        wrong = [imagine(world, scene, other.actions) for scene, other in others]
        figures |= _figures(wrong, [scene for scene, _ in others], "_other_take")
    figures["psnr_warp"] = float(np.mean([_psnr(_warped(s), s.truth.images) for s in scenes]))
    figures["tactile_mse_zero"] = _touch_error([_nothing(scene) for scene in scenes], scenes)
    figures["num_rollouts"] = float(len(scenes))
    return PredictionResult(figures, _pictures(scenes, imagined))


def read_scene(reader: EpisodeReader) -> Scene:
    """Convert a stored robot episode to a scene."""
    about = reader.attributes
    reader.require_images(CAMERA)
    window = reader.window(0, reader.num_steps, cameras=(CAMERA,))
    first = Observation(
        first_step=0,
        images={CAMERA: window.images[CAMERA][:1]},
        tactile_kpa=window.tactile_kpa[:1],
        action_reached=window.actions[:1],
        reached_is_measured=True,
    )
    start = RolloutStart(
        about.task,
        about.seed or 0,
        about.instruction,
        observation=first,
        anchor=window.anchor,
        K_head=window.K_head,
    )
    num_steps = (reader.num_steps - 1) // CHUNK_STEPS * CHUNK_STEPS
    actions = reader.read("action_commanded").values[1 : num_steps + 1]
    truth = Future(
        window.images[CAMERA][CHUNK_STEPS : num_steps + 1 : CHUNK_STEPS],
        window.tactile_kpa[1 : num_steps + 1],
    )
    return Scene(about.episode_id, start, actions, truth, about.model_rate_hz)


def imagine(world: World[Any], scene: Scene, actions: Float64[np.ndarray, "steps 67"]) -> Future:
    """Predict the future of a scene for given actions."""
    state = world.reset(scene.start).state
    images, touch = [], []
    for first in range(0, len(actions), CHUNK_STEPS):
        chunk, seed = actions[first : first + CHUNK_STEPS], scene.start.seed + first
        # A world is functional: two calls give touch of all steps and only the last image.
        felt = world.step(state, chunk, seed=seed, selector=_NO_IMAGE)
        seen = world.step(state, chunk, seed=seed, selector=_LAST_STEP)
        images.append(seen.observation.images[CAMERA][-1])
        touch.append(felt.observation.tactile_kpa)
        state = felt.state
    return Future(np.stack(images), np.concatenate(touch))


def _other(scene: Scene, scenes: Sequence[Scene]) -> Scene | None:
    """The next, different scene of the same task."""
    mine = [one for one in scenes if one.start.task == scene.start.task]
    at = next(index for index, one in enumerate(mine) if one is scene)
    turned = mine[at + 1 :] + mine[:at]
    return next((one for one in turned if one.start.seed != scene.start.seed), None)


def _still(actions: np.ndarray, *, head_moves: bool) -> Float64[np.ndarray, "steps 67"]:
    rows = np.repeat(actions[:1], len(actions), axis=0)
    if head_moves:
        rows[:, CAMERA_HEAD] = actions[:, CAMERA_HEAD]
    return rows


def _first(scene: Scene) -> Observation:
    if scene.start.observation is None:
        raise InvalidInputError(f"scene {scene.episode_id!r}: begins without an observation")
    return scene.start.observation


def _copy(scene: Scene) -> Future:
    first, truth = _first(scene), scene.truth
    return Future(
        np.repeat(first.images[CAMERA], len(truth.images), axis=0),
        np.repeat(first.tactile_kpa, len(truth.tactile_kpa), axis=0),
    )


def _nothing(scene: Scene) -> Future:
    return Future(scene.truth.images, np.zeros_like(scene.truth.tactile_kpa))


def _warped(scene: Scene) -> UInt8[np.ndarray, "chunks h w 3"]:
    anchor, K_head = scene.start.anchor, scene.start.K_head
    if anchor is None or K_head is None:
        raise InvalidInputError(f"scene {scene.episode_id!r}: begins without camera")
    cameras = poses_from_actions(scene.actions, anchor).Ts_world_camera_head
    image, then = _first(scene).images[CAMERA][0], anchor.T_world_camera_head
    ends = cameras[CHUNK_STEPS - 1 :: CHUNK_STEPS]
    return np.stack([warp_over_table(image, K_head, then, now) for now in ends])


def _psnr(images: np.ndarray, truth: np.ndarray) -> float:
    return float(image_metrics.psnr(predicted=images, true=truth))


def _touch_error(futures: Sequence[Future], scenes: Sequence[Scene]) -> float:
    return float(
        tactile_metrics.mse(
            predicted_kpa=np.stack([future.tactile_kpa for future in futures]),
            true_kpa=np.stack([scene.truth.tactile_kpa for scene in scenes]),
        )
    )


def _figures(futures: Sequence[Future], scenes: Sequence[Scene], suffix: str) -> dict[str, float]:
    pairs = list(zip(futures, scenes, strict=True))
    return {
        f"psnr{suffix}": float(np.mean([_psnr(f.images, s.truth.images) for f, s in pairs])),
        f"tactile_mse{suffix}": _touch_error(futures, scenes),
        f"contact_f1{suffix}": float(
            tactile_metrics.contact_f1(
                predicted_kpa=np.stack([future.tactile_kpa for future in futures]),
                true_kpa=np.stack([scene.truth.tactile_kpa for scene in scenes]),
            )
        ),
    }


def _pictures(scenes: Sequence[Scene], imagined: Sequence[Future]) -> tuple[PredictionPicture, ...]:
    """The first scene of every task."""
    firsts: dict[str, int] = {}
    for index, scene in enumerate(scenes):
        firsts.setdefault(scene.start.task, index)
    return tuple(_picture(scenes[index], imagined[index]) for index in sorted(firsts.values()))


def _picture(scene: Scene, imagined: Future) -> PredictionPicture:
    ends = np.arange(CHUNK_STEPS, len(scene.actions) + 1, CHUNK_STEPS)
    return PredictionPicture(
        title=f"{scene.start.instruction} A whole rollout, from its first image and touch.",
        times_s=ends / scene.model_rate_hz,
        true_images=scene.truth.images,
        predicted_images=imagined.images,
        true_tactile_kpa=scene.truth.tactile_kpa[ends - 1],
        predicted_tactile_kpa=imagined.tactile_kpa[ends - 1],
    )
