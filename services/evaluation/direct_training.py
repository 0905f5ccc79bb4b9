"""Training of a direct judge: first the object finder, then the recurrent network.

The finder is trained on true object poses, like the world model's start reader. The recurrent
network is trained on true poses with noise as large as the finder's errors on development episodes.
"""

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from dextouch.episodes import split_by_scene
from dextouch.errors import InvalidInputError
from dextouch.geometry import transform_from_pose
from services.evaluation.calibration import Calibration, expected_calibration_error, fit_calibration
from services.evaluation.checkpoints import Checkpoint, CheckpointMetadata, network_tensors
from services.evaluation.demonstrations import instructions_of
from services.evaluation.direct_data import LabelledAttempt, attempts_hash
from services.evaluation.direct_judge import KIND, DirectJudge
from services.evaluation.direct_network import (
    Commands,
    DirectNetwork,
    DirectShape,
    ObjectFinder,
    Objects,
    Views,
    attempt_tensors,
    views_of,
)
from services.evaluation.object_features import MAX_OBJECTS
from services.evaluation.optimization import optimized
from services.evaluation.statistics import area_under_roc
from services.evaluation.success_probe_figures import MIN_OUTCOMES
from services.evaluation.training_settings import DirectSettings

_UNIT_M = 0.05
_CHECK_EVERY = 100


@dataclass(frozen=True)
class Learned:
    """Training tensors: views with object poses, starts with commands and outcomes."""

    views: Views
    seen: Objects
    starts: Views
    commands: Commands
    placed: Objects
    success: torch.Tensor

    @classmethod
    def of(cls, items: Sequence[LabelledAttempt], shape: DirectShape) -> "Learned":
        """Training tensors of some episodes."""
        views = [(item, view) for item in items for view in item.views]
        starts, commands = attempt_tensors([item.attempt for item in items], shape)
        return cls(
            views_of(
                np.stack([view.image for _, view in views]),
                np.stack([item.attempt.K_head for item, _ in views]),
                np.stack([view.T_world_camera for _, view in views]),
                [shape.tasks.index(item.task) for item, _ in views],
            ),
            _objects([view.object_poses for _, view in views]),
            starts,
            commands,
            _objects([item.views[0].object_poses for item in items]),
            torch.tensor([float(item.success) for item in items]),
        )


def _objects(poses: Sequence[np.ndarray]) -> Objects:
    """Poses [objects, 7] as tensors; empty slots are zero."""
    position_m = np.zeros((len(poses), MAX_OBJECTS, 3), np.float32)
    axes = np.zeros((len(poses), MAX_OBJECTS, 2, 3), np.float32)
    for row, pose in enumerate(poses):
        T = transform_from_pose(pose)
        position_m[row, : len(pose)] = T[:, :3, 3]
        axes[row, : len(pose)] = np.stack([T[:, :3, 2], T[:, :3, 0]], axis=1)
    return Objects(torch.from_numpy(position_m), torch.from_numpy(axes))


def train_direct_judge(
    items: Sequence[LabelledAttempt], settings: DirectSettings, *, command: str
) -> Checkpoint:
    """Train a judge to predict success from first observations and commands.

    A share of the seeds is held out for early stopping, calibration and evaluation.

    Raises:
        InvalidInputError: only one outcome, or too few seeds to hold some out.
    """
    torch.manual_seed(settings.seed)
    share = settings.development_share
    training, apart = split_by_scene(items, held_out_share=share, salt="direct judge ")
    if len({item.success for item in training}) < 2:
        raise InvalidInputError(
            f"direct judge: all {len(training)} training episodes have the same outcome, expected "
            "both; record with more noise levels"
        )
    tasks = tuple(sorted({item.task for item in training}))
    apart = [item for item in apart if item.task in tasks]
    counts = {item.task: len(item.views[0].object_poses) for item in training}
    shape = DirectShape(
        tasks=tasks,
        num_objects=tuple(counts[task] for task in tasks),
        image_size_px=training[0].attempt.image.shape[0],
    )
    network = DirectNetwork(shape)
    learned, checked = Learned.of(training, shape), Learned.of(apart, shape)
    started = time.process_time()
    _train_finder(network.finder, learned, settings, network.num_objects)
    noise_m = _finder_errors(network.finder, checked, network.num_objects)
    best = _train_judge(network, (learned, checked), settings, noise_m)
    cpu_s = time.process_time() - started
    metadata = CheckpointMetadata(
        kind=KIND,
        command=command,
        seed=settings.seed,
        data_hash=attempts_hash(items),
        tasks=tasks,
        training_episodes=tuple(item.episode_id for item in items),
        training_starts=tuple(sorted({item.start_digest for item in items})),
        settings={
            "shape": shape.model_dump(mode="json"),
            "training": settings.model_dump(),
            "instructions": instructions_of(items),
        },
        metrics={
            "training_cpu_s": round(cpu_s, 1),
            "num_training_episodes": len(training),
            "num_development_episodes": len(apart),
            "best_step": best,
            **{
                f"finder_sigma_mm_{task}": 1e3 * float(noise_m[index, : counts[task], :2].max())
                for index, task in enumerate(tasks)
            },
        },
    )
    return _calibrated(Checkpoint(metadata, network_tensors(network)), apart)


def _calibrated(checkpoint: Checkpoint, apart: Sequence[LabelledAttempt]) -> Checkpoint:
    """The checkpoint with calibrations and metrics on the held-out episodes."""
    judge, metadata = DirectJudge(checkpoint), checkpoint.metadata
    calibration: dict[str, Calibration] = {}
    metrics = dict(metadata.metrics)
    for task in metadata.tasks:
        mine = [item for item in apart if item.task == task]
        outcomes = np.array([item.success for item in mine], dtype=bool)
        if min(outcomes.sum(), (~outcomes).sum()) < MIN_OUTCOMES:
            continue
        odds = judge.log_odds([item.attempt for item in mine])
        calibration[task] = fit_calibration(odds, outcomes)
        metrics[f"development_auc_{task}"] = area_under_roc(odds, outcomes)
        predicted = calibration[task].probabilities(odds)
        metrics[f"development_ece_{task}"] = expected_calibration_error(predicted, outcomes)
    added = {"calibration": {task: one.model_dump() for task, one in calibration.items()}}
    settings = {**metadata.settings, **added}
    return replace(
        checkpoint, metadata=metadata.model_copy(update={"settings": settings, "metrics": metrics})
    )


def _train_finder(
    finder: ObjectFinder, learned: Learned, settings: DirectSettings, num_objects: torch.Tensor
) -> None:
    """Minimize errors of object positions and axes over views."""
    used = _used(learned.views, num_objects)
    for task in range(len(finder.height_m)):
        mine = learned.views.task == task
        finder.height_m[task] = learned.seen.position_m[mine, :, 2].median(dim=0).values

    def loss(generator: torch.Generator) -> torch.Tensor:
        index = torch.randint(len(used), (settings.batch_size,), generator=generator)
        views, there = learned.views[index], used[index]
        noise = torch.randn(views.image.shape, generator=generator) * settings.image_noise
        light = torch.randn((len(index), 1, 1, 1), generator=generator) * settings.brightness
        image = views.image.float() / 255 - 0.5 + noise + light
        predicted = finder.find(image, views, bfloat16=settings.bfloat16)
        position = functional.smooth_l1_loss(
            predicted.position_m / _UNIT_M, learned.seen.position_m[index] / _UNIT_M,
            beta=0.1, reduction="none",
        ).sum(-1)  # fmt: skip
        axes = (predicted.axes - learned.seen.axes[index]).square().sum((-1, -2))
        return ((position + axes) * there).sum() / there.sum()

    limits = (settings.num_finder_steps, settings.max_cpu_s * settings.finder_share)
    for _ in optimized(finder, loss, settings, limits=limits, title="finder"):
        pass
    finder.eval()


def _used(views: Views, num_objects: torch.Tensor) -> torch.Tensor:
    return torch.arange(MAX_OBJECTS) < num_objects[views.task][:, None]


@torch.no_grad()
def _found(finder: ObjectFinder, views: Views) -> Objects:
    parts = [finder(views[rows]) for rows in torch.split(torch.arange(len(views.task)), 128)]
    return Objects(*(torch.cat([getattr(p, n) for p in parts]) for n in ("position_m", "axes")))


def _finder_errors(
    finder: ObjectFinder, checked: Learned, num_objects: torch.Tensor
) -> torch.Tensor:
    """Error (m) at the start along each axis, by task and object, as sigma from the median."""
    off = (_found(finder, checked.starts).position_m - checked.placed.position_m).abs()
    sigma = torch.zeros((len(num_objects), MAX_OBJECTS, 3))
    for task in range(len(num_objects)):
        mine = off[checked.starts.task == task]
        if len(mine):
            # The median of |x| of a normal distribution is 0.6745 sigma.
            sigma[task] = mine.median(dim=0).values / 0.6745
    return sigma


def _train_judge(
    network: DirectNetwork,
    sets: tuple[Learned, Learned],
    settings: DirectSettings,
    noise_m: torch.Tensor,
) -> int:
    """Minimize the cross entropy; keeps the weights of the best step on held-out episodes."""
    learned, checked = sets
    found, shown = (_found(network.finder, one.starts) for one in sets)

    def loss(generator: torch.Generator) -> torch.Tensor:
        num_rows = len(learned.success)
        index = torch.randint(num_rows, (settings.batch_size,), generator=generator)
        task = learned.starts.task[index]
        drawn = torch.randn((len(index), MAX_OBJECTS, 3), generator=generator)
        placed = learned.placed.position_m[index] + drawn * noise_m[task]
        objects = Objects(placed, found.axes[index])
        odds = network.judge(objects, learned.commands[index], task)
        return functional.binary_cross_entropy_with_logits(odds, learned.success[index])

    parts = nn.ModuleList([network.task, network.entry, network.recurrent, network.head])
    least, best, weights = float("inf"), 0, copy.deepcopy(parts.state_dict())
    limits = (settings.num_judge_steps, settings.max_cpu_s * (1 - settings.finder_share))
    for used in optimized(parts, loss, settings, limits=limits, title="direct judge"):
        if used.step % _CHECK_EVERY:
            continue
        parts.eval()
        with torch.no_grad():
            odds = network.judge(shown, checked.commands, checked.starts.task)
            error = functional.binary_cross_entropy_with_logits(odds, checked.success)
        parts.train()
        if float(error) < least:
            least, best, weights = float(error), used.step, copy.deepcopy(parts.state_dict())
    parts.load_state_dict(weights if best else parts.state_dict())
    network.eval()
    return best
