"""Errors of models of both forms on held-out episodes, compared with simple baselines."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8
from torch import Tensor

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import CAMERA_HEAD
from dextouch.metrics import image as image_metrics
from dextouch.metrics import tactile as tactile_metrics
from dextouch.schemas import CHUNK_STEPS, ActionKind
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.world_model.checkpoints import StateBounds
from services.world_model.dynamics.features import STEPS_PER_LATENT
from services.world_model.dynamics.model import DynamicsModel, ImaginedSteps, batched
from services.world_model.network.codecs import to_uint8, to_unit
from services.world_model.network.inputs import PredictionRequest, build_inputs
from services.world_model.network.model import JointWorldModel, stack_noise
from services.world_model.training import joint_dataset
from services.world_model.training.member_training import reader_errors
from services.world_model.training.scene_table import SceneTable

BATCH = 24
# Start steps of rollouts, as far as they have images.
STARTS = (0, 16, 32, 48, 64)
_STATE_BATCH = 64
# Bounds are this quantile over held-out chunks of 16 steps from any start, so that at most one in
# 200 episodes of five chunks exceeds one.
_BOUND_QUANTILE = 0.999
_SMALLEST_DISTANCE = 1e-3
Item = TypeVar("Item")


@dataclass(frozen=True)
class Futures:
    """Images and pressures after the first step, for all windows."""

    images: UInt8[np.ndarray, "n steps h w 3"]
    tactile_kpa: Float32[np.ndarray, "n steps 2 taxels"]
    measured: Bool[np.ndarray, "n steps 2 taxels"] | None = None
    layout: TactileLayout = DEXTOUCH_V1


def evaluate_prediction(
    model: JointWorldModel,
    episodes: Sequence[joint_dataset.EpisodeArrays],
    *,
    train_fingerprints: Sequence[str],
    stride: int = 8,
    action_kind: ActionKind = "commanded",
) -> dict[str, float]:
    """Errors over every window of held-out episodes that starts at a multiple of `stride`.

    Returns psnr (dB, mean over images), tactile_mse (kPa²) and contact_f1, each also for the
    baselines named by the suffix, and num_windows; psnr alone without touch. _copy repeats the
    first step, tactile_mse_zero predicts no touch, _codec encodes and decodes the truth. The model
    is given the actions of another held-out take of the task at the same time for _other_take, such
    in which nothing moves for _hold, and only the head for _hands_still: if it is no better with
    its own, it does not use them.

    Raises:
        InvalidInputError: an episode that was trained on, or no window at all.
    """
    refuse_trained(episodes, train_fingerprints, "the model")
    steps = model.config.max_steps
    places = evaluated_places(episodes, steps, stride)
    windows = [_cut(episode, start, steps, action_kind) for episode, start in places]
    truth = Futures(
        np.stack([w.images[1:] for w in windows]),
        np.stack([w.tactile_kpa[1:] for w in windows]),
        np.stack([w.tactile_valid[1:, :, None] & w.measured_taxels for w in windows]),
        model.config.tactile_layout,
    )
    first = Futures(
        np.stack([w.images[:1] for w in windows]).repeat(steps - 1, axis=1),
        np.stack([w.tactile_kpa[:1] for w in windows]).repeat(steps - 1, axis=1),
    )
    requests = [window.request for window in windows]
    figures = _figures(predict_all(model, requests), truth, "")
    figures |= _figures(first, truth, "_copy")
    figures |= _figures(_through_codec(model, windows), truth, "_codec")
    figures["tactile_mse_zero"] = tactile_metrics.mse(
        predicted_kpa=np.zeros_like(truth.tactile_kpa),
        true_kpa=truth.tactile_kpa,
        measured=truth.measured,
        layout=model.config.tactile_layout,
    )
    others = _actions_of_other_takes(places, requests, action_kind)
    if others:
        kept = [index for index, _ in others]
        wrong = predict_all(model, [request for _, request in others])
        measured = None if truth.measured is None else truth.measured[kept]
        right = Futures(truth.images[kept], truth.tactile_kpa[kept], measured, truth.layout)
        figures |= _figures(wrong, right, "_other_take")
    for suffix, head_moves in (("_hold", False), ("_hands_still", True)):
        still = []
        for request in requests:
            actions = np.repeat(request.actions[:1], steps, axis=0)
            if head_moves:
                actions[:, CAMERA_HEAD] = request.actions[:, CAMERA_HEAD]
            still.append(replace(request, actions=actions))
        figures |= _figures(predict_all(model, still), truth, suffix)
    if not model.config.use_touch:
        figures = {name: value for name, value in figures.items() if name.startswith("psnr")}
    return {**figures, "num_windows": float(len(windows))}


def evaluated_places(
    episodes: Sequence[joint_dataset.EpisodeArrays], num_steps: int, stride: int
) -> list[tuple[joint_dataset.EpisodeArrays, int]]:
    """Episodes and first steps of the windows that start at a multiple of `stride`.

    Raises InvalidInputError if there is none.
    """
    places = [
        (episode, start)
        for episode in episodes
        for start in joint_dataset.window_starts(episode, num_steps).tolist()
        if start % stride == 0
    ]
    if not places:
        raise InvalidInputError(
            f"evaluation: got {len(episodes)} episodes without a window of {num_steps} steps, "
            "expected at least one"
        )
    return places


def refuse_trained(
    episodes: Sequence[joint_dataset.TrainingEpisode], fingerprints: Collection[str], model: str
) -> None:
    """Raise if a model was trained on any of the episodes, by the hash of their content."""
    trained = set(fingerprints)
    seen = [episode.episode_id for episode in episodes if episode.fingerprint() in trained]
    if seen:
        raise InvalidInputError(
            f"evaluation: {model} was trained on {len(seen)} of the held-out episodes {seen[:3]}, "
            "expected others; use a held-out store that it has not seen",
            episodes=seen,
        )


def predict_all(model: JointWorldModel, requests: Sequence[PredictionRequest]) -> Futures:
    """One sample per request, in batches; the noise of request i is seeded by i."""

    def predicted(part: Sequence[PredictionRequest], begin: int) -> tuple[Tensor, Tensor]:
        inputs = build_inputs(part, model.config)
        generators = [torch.Generator().manual_seed(begin + index) for index in range(len(part))]
        noises = [model.noise(inputs.num_steps, each) for each in generators]
        future = model.predict(inputs, stack_noise(noises))
        return future.images, future.tactile_kpa

    return _in_batches(model, requests, predicted)


def _in_batches(
    model: JointWorldModel,
    items: Sequence[Item],
    futures_of: Callable[[Sequence[Item], int], tuple[Tensor, Tensor]],
) -> Futures:
    """Images and touch of parts of the items, each given with the index that it begins at."""
    # The autoencoder of the full size takes gigabytes for each window.
    size = BATCH if model.config.wan is None else 1
    parts = [futures_of(items[begin : begin + size], begin) for begin in range(0, len(items), size)]
    return Futures(
        np.concatenate([to_uint8(images).cpu().numpy() for images, _ in parts]),
        np.concatenate([tactile_kpa.cpu().numpy() for _, tactile_kpa in parts]),
    )


def _cut(
    episode: joint_dataset.EpisodeArrays, start: int, num_steps: int, kind: ActionKind
) -> joint_dataset.Window:
    available: ActionKind = kind if kind in episode.actions else "measured"
    return episode.cut(joint_dataset.WindowPosition(0, start, num_steps, available))


def _through_codec(model: JointWorldModel, windows: Sequence[joint_dataset.Window]) -> Futures:
    def decoded(part: Sequence[joint_dataset.Window], _: int) -> tuple[Tensor, Tensor]:
        batch = joint_dataset.stack_windows(part)
        shown, felt = batch.images.to(model.device), batch.tactile_kpa.to(model.device)
        images: Tensor = model.codec.decode(model.codec.encode(to_unit(shown)))
        touch = model.tokenizer.decode(model.tokenizer.encode(felt))
        return images[:, 1:], touch[:, 1:]

    return _in_batches(model, windows, decoded)


def _actions_of_other_takes(
    places: Sequence[tuple[joint_dataset.EpisodeArrays, int]],
    requests: Sequence[PredictionRequest],
    kind: ActionKind,
) -> list[tuple[int, PredictionRequest]]:
    """Each request with the actions of the next episode of its task at the same time."""
    by_task: dict[str, list[joint_dataset.EpisodeArrays]] = {}
    for episode, _ in places:
        if all(episode is not known for known in by_task.setdefault(episode.task, [])):
            by_task[episode.task].append(episode)
    others = []
    for index, ((episode, start), request) in enumerate(zip(places, requests, strict=True)):
        siblings = by_task[episode.task]
        here = next(i for i, known in enumerate(siblings) if known is episode)
        other = siblings[(here + 1) % len(siblings)]
        num_steps = len(request.actions)
        if other is not episode and start + num_steps <= len(other):
            taken = _cut(other, start, num_steps, kind).request
            swapped = replace(request, actions=taken.actions, action_kind=taken.action_kind)
            others.append((index, swapped))
    return others


def _figures(predicted: Futures, true: Futures, suffix: str) -> dict[str, float]:
    touch: dict[str, Any] = {
        "predicted_kpa": predicted.tactile_kpa,
        "true_kpa": true.tactile_kpa,
        "measured": true.measured,
        "layout": true.layout,
    }
    return {
        f"psnr{suffix}": image_metrics.psnr(predicted=predicted.images, true=true.images),
        f"tactile_mse{suffix}": tactile_metrics.mse(**touch),
        f"contact_f1{suffix}": tactile_metrics.contact_f1(**touch),
    }


def evaluate_dynamics(
    dynamics: DynamicsModel, table: SceneTable
) -> tuple[dict[str, float], StateBounds]:
    """Predict every episode from its first step and from later ones, and compare.

    Returns errors of readers (first member) and objects (median at a chunk's end) in mm, contact F1
    and error of touch by chunks of 16 steps (names with `from_16` are of starts at step 16), and
    the bounds that almost no held-out chunk exceeds.
    """
    figures: dict[str, float] = {}
    disagreement_m, distance = [], []
    last_start = table.num_steps - 1 - STEPS_PER_LATENT
    for start in (s for s in STARTS if s in table.image_steps and s <= last_start):
        imagined = _imagined(dynamics, table, start)
        figures |= _chunk_figures(imagined, table, start, dynamics.config.tactile_layout)
        if start == 0:
            figures |= _episode_figures(imagined, table, dynamics)
        within = table.within(torch.arange(len(table)), start)
        disagreement_m.append(chunk_peaks(imagined.disagreement_m, within))
        distance.append(chunk_peaks(imagined.distance, within))
    rounded = {name: round(float(value), 4) for name, value in figures.items()}
    return rounded, StateBounds(
        disagreement_m=float(torch.cat(disagreement_m).quantile(_BOUND_QUANTILE)),
        distance=max(_SMALLEST_DISTANCE, float(torch.cat(distance).quantile(_BOUND_QUANTILE))),
        of_chunks=True,
    )


def check_long_enough(heldout: SceneTable) -> None:
    """Raise InvalidInputError, hours early, if no held-out episode has a whole chunk."""
    if int(heldout.length.max()) <= CHUNK_STEPS:
        raise InvalidInputError(
            f"state model: the longest held-out episode has {int(heldout.length.max())} steps, "
            f"expected more than the {CHUNK_STEPS} of a chunk; hold out others with --heldout STORE"
        )


def chunk_peaks(
    latents: Float32[Tensor, "episodes latents"], within: Bool[Tensor, "episodes latents"]
) -> Float32[Tensor, " chunks"]:
    """Maximum of each chunk of 16 steps that lies within its episode."""
    size = CHUNK_STEPS // STEPS_PER_LATENT
    pairs = zip(torch.split(latents, size, dim=1), torch.split(within, size, dim=1), strict=True)
    return torch.cat([chunk.amax(1)[inside.all(1)] for chunk, inside in pairs])


def _chunk_figures(
    imagined: ImaginedSteps, table: SceneTable, start: int, layout: TactileLayout
) -> dict[str, float]:
    figures: dict[str, float] = {}
    place = "" if start == 0 else f"from_{start}_"
    for index, first in enumerate(range(start, table.num_steps - 1, CHUNK_STEPS)):
        end = min(first + CHUNK_STEPS, table.num_steps - 1)
        # Of shorter episodes, chunks that go beyond their end are left out.
        whole = table.length > end
        if not whole.any():
            break
        steps, predicted = (slice(k, k + CHUNK_STEPS) for k in (first + 1, first - start))
        true = table.tactile_kpa[whole, steps].float().numpy()
        measured = table.felt[whole, steps, :, None] & table.measured_taxels[whole, None]
        guesses = {"": imagined.tactile_kpa[whole, predicted].numpy()}
        if start == 0:
            before = table.tactile_kpa[whole, first : first + 1].float().numpy()
            guesses["_of_copy"] = np.broadcast_to(before, true.shape)
        for name, guess in guesses.items() if measured.any() else ():
            chunk = f"{place}chunk_{index + 1}{name}"
            pair = {"predicted_kpa": guess, "true_kpa": true, "measured": measured.numpy()}
            figures[f"contact_f1_{chunk}"] = tactile_metrics.contact_f1(**pair, layout=layout)
            figures[f"tactile_mse_{chunk}"] = tactile_metrics.mse(**pair, layout=layout)
        position_m = imagined.poses.position_m[:, end - start - 1]
        off_mm, there = _object_errors(position_m, table, start, end)
        if there.any():
            figures[f"object_mm_{place}chunk_{index + 1}"] = float(off_mm[there].median())
    return figures


def _episode_figures(
    imagined: ImaginedSteps, table: SceneTable, dynamics: DynamicsModel
) -> dict[str, float]:
    """Errors of objects at the end and of readers at the start, by task."""
    figures: dict[str, float] = {}
    rows = torch.arange(len(table))
    last = table.length - 1
    off_mm, there = _object_errors(imagined.poses.position_m[rows, last - 1], table, 0, last)
    for index, task in enumerate(dynamics.config.tasks):
        found = there & (table.task == index)[:, None]
        if found.any():
            figures[f"final_object_mm_{task}"] = float(off_mm[found].median())
    return figures | reader_errors(dynamics.readers()[0], table)


def _object_errors(
    position_m: Float32[Tensor, "episodes objects 3"],
    table: SceneTable,
    start: int,
    step: int | Int64[Tensor, " episodes"],
) -> tuple[Tensor, Tensor]:
    """Position errors in mm at a step, and which objects are known to be there at both steps."""
    rows = torch.arange(len(table))
    true = table.objects_at(rows, step)
    there = (true.present > 0) & (table.objects_at(rows, start).present > 0)
    there &= table.objects_known[rows, step] & table.objects_known[:, start]
    return 1e3 * (position_m - true.position_m).norm(dim=-1), there


@torch.no_grad()
def _imagined(dynamics: DynamicsModel, table: SceneTable, start: int) -> ImaginedSteps:
    """Predictions of whole episodes from one start."""
    parts = []
    for rows in torch.split(torch.arange(len(table)), _STATE_BATCH):
        first = table.first_steps(rows, torch.full_like(rows, start))
        commands = table.commands(rows, start, torch.zeros(len(rows), dtype=torch.bool))
        touch = table.tactile_kpa[rows, start].float()
        sent = table.commanded[rows].float()
        memory = dynamics.begin(first, touch, commands[:1], sent, table.instruction[rows])
        parts.append(dynamics.advance(memory, commands[1:])[1])
    return batched(parts)
