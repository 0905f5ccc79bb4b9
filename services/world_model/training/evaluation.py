"""Errors of a model on held-out episodes, compared with simple baselines."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import CAMERA_HEAD
from dextouch.metrics import image as image_metrics
from dextouch.metrics import tactile as tactile_metrics
from dextouch.schemas import ActionKind
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.world_model.network.codecs import to_uint8, to_unit
from services.world_model.network.inputs import PredictionRequest, build_inputs
from services.world_model.network.model import JointWorldModel, stack_noise
from services.world_model.training import dataset

BATCH = 24
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
    episodes: Sequence[dataset.EpisodeArrays],
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
    places = [
        (episode, start)
        for episode in episodes
        for start in dataset.window_starts(episode, model.config.max_steps).tolist()
        if start % stride == 0
    ]
    if not places:
        raise InvalidInputError(
            f"evaluation: got {len(episodes)} episodes without a window of "
            f"{model.config.max_steps} steps, expected at least one"
        )
    steps = model.config.max_steps
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


def refuse_trained(
    episodes: Sequence[dataset.TrainingEpisode], train_fingerprints: Collection[str], model: str
) -> None:
    """Raise if a model was trained on any of the episodes, by the hash of their content."""
    trained = set(train_fingerprints)
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
    episode: dataset.EpisodeArrays, start: int, num_steps: int, kind: ActionKind
) -> dataset.Window:
    available: ActionKind = kind if kind in episode.actions else "measured"
    return episode.cut(dataset.WindowPosition(0, start, num_steps, available))


def _through_codec(model: JointWorldModel, windows: Sequence[dataset.Window]) -> Futures:
    def decoded(part: Sequence[dataset.Window], _: int) -> tuple[Tensor, Tensor]:
        batch = dataset.stack_windows(part)
        shown, felt = batch.images.to(model.device), batch.tactile_kpa.to(model.device)
        images: Tensor = model.codec.decode(model.codec.encode(to_unit(shown)))
        touch = model.tokenizer.decode(model.tokenizer.encode(felt))
        return images[:, 1:], touch[:, 1:]

    return _in_batches(model, windows, decoded)


def _actions_of_other_takes(
    places: Sequence[tuple[dataset.EpisodeArrays, int]],
    requests: Sequence[PredictionRequest],
    kind: ActionKind,
) -> list[tuple[int, PredictionRequest]]:
    """Each request with the actions of the next episode of its task at the same time."""
    by_task: dict[str, list[dataset.EpisodeArrays]] = {}
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
