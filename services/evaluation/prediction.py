"""Prediction errors of a world on held-out episodes, compared with simple baselines.

Only the `World` interface is used, so that all kinds of world models are measured in the same way:
over whole open-loop rollouts, from the first observed step to the last.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    """Figures for `report.json`, and the images of one rollout per task."""

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
    still = {"_hold": False, "_hands_still": True}
    futures = {
        "": [(one, imagine(world, one, one.actions)) for one in scenes],
        "_copy": [(one, _copy(one)) for one in scenes],
        "_other_take": [
            (one, imagine(world, one, other.actions))
            for one in scenes
            if (other := _other(one, scenes)) is not None
        ],
    } | {
        suffix: [(one, imagine(world, one, _still(one, head_moves=head_moves))) for one in scenes]
        for suffix, head_moves in still.items()
    }
    figures: dict[str, float] = {}
    for suffix, pairs in futures.items():
        if pairs:
            figures |= {f"{name}{suffix}": value for name, value in _errors(pairs).items()}
    warped = [(one, replace(one.truth, images=_warped(one))) for one in scenes]
    unfelt = np.zeros_like(scenes[0].truth.tactile_kpa)
    nothing = [(one, replace(one.truth, tactile_kpa=unfelt)) for one in scenes]
    figures["psnr_warp"] = _errors(warped)["psnr"]
    figures["tactile_mse_zero"] = _errors(nothing)["tactile_mse"]
    figures["num_rollouts"] = float(len(scenes))
    return PredictionResult(figures, _pictures(futures[""]))


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


def _still(scene: Scene, *, head_moves: bool) -> Float64[np.ndarray, "steps 67"]:
    rows = np.repeat(scene.actions[:1], len(scene.actions), axis=0)
    if head_moves:
        rows[:, CAMERA_HEAD] = scene.actions[:, CAMERA_HEAD]
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


def _warped(scene: Scene) -> UInt8[np.ndarray, "chunks h w 3"]:
    anchor, K_head = scene.start.anchor, scene.start.K_head
    if anchor is None or K_head is None:
        raise InvalidInputError(f"scene {scene.episode_id!r}: begins without camera")
    cameras = poses_from_actions(scene.actions, anchor).Ts_world_camera_head
    image, then = _first(scene).images[CAMERA][0], anchor.T_world_camera_head
    ends = cameras[CHUNK_STEPS - 1 :: CHUNK_STEPS]
    return np.stack([warp_over_table(image, K_head, then, now) for now in ends])


def _errors(pairs: Sequence[tuple[Scene, Future]]) -> dict[str, float]:
    """Errors of predicted futures, over all scenes together."""
    touch = {
        "predicted_kpa": np.stack([future.tactile_kpa for _, future in pairs]),
        "true_kpa": np.stack([scene.truth.tactile_kpa for scene, _ in pairs]),
    }
    decibels = [
        float(image_metrics.psnr(predicted=future.images, true=scene.truth.images))
        for scene, future in pairs
    ]
    return {
        "psnr": float(np.mean(decibels)),
        "tactile_mse": float(tactile_metrics.mse(**touch)),
        "contact_f1": float(tactile_metrics.contact_f1(**touch)),
    }


def _pictures(rollouts: Sequence[tuple[Scene, Future]]) -> tuple[PredictionPicture, ...]:
    """The first scene of every task."""
    firsts: dict[str, PredictionPicture] = {}
    for scene, imagined in rollouts:
        if scene.start.task in firsts:
            continue
        ends = np.arange(CHUNK_STEPS, len(scene.actions) + 1, CHUNK_STEPS)
        firsts[scene.start.task] = PredictionPicture(
            title=f"{scene.start.instruction} A whole rollout, from its first image and touch.",
            times_s=ends / scene.model_rate_hz,
            true_images=scene.truth.images,
            predicted_images=imagined.images,
            true_tactile_kpa=scene.truth.tactile_kpa[ends - 1],
            predicted_tactile_kpa=imagined.tactile_kpa[ends - 1],
        )
    return tuple(firsts.values())
