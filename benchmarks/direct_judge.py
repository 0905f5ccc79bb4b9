"""Direct judge: predicts success from the first observation and the commands, and imagines nothing.

It is the evaluator's baseline for world models: imagination is useful if imagined endings predict
success better than this judge, trained on the same episodes for as much CPU time. It has the state
model's start reader and inputs, and a recurrent network that is told the outcome alone.
`python -m benchmarks direct-judge` trains one.
"""

import argparse
import copy
import shlex
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Bar
from dextouch.episodes import (
    EpisodeGrid,
    EpisodeStore,
    data_hash,
    needs,
    select_episodes,
    split_by_scene,
)
from dextouch.errors import InvalidInputError
from dextouch.schemas import MAX_OBJECTS, RolloutStart
from dextouch.streams import HEAD_CAMERA
from services.evaluation.classifier_calibration import (
    MIN_OUTCOMES,
    expected_calibration_error,
    fit_calibration,
)
from services.evaluation.matched_starts import start_digest
from services.evaluation.statistics import area_under_roc
from services.evaluation.success_classifier import Calibration
from services.evaluation.trained_networks import (
    Checkpoint,
    CheckpointMetadata,
    load_checkpoint,
    load_network,
    network_tensors,
    optimized,
    save_checkpoint,
)
from services.networks.training_settings import USUAL_IMAGE_PX, TrainingSettings
from services.world_model.dynamics.core import NUM_PADS, OWN_SIZE, own_features
from services.world_model.dynamics.features import (
    BOX_AXES,
    SLOT_SIZE,
    Commands,
    DynamicsConfig,
    compressed,
    hand_motion,
    rotations,
    slot_features,
)
from services.world_model.dynamics.model import first_steps
from services.world_model.dynamics.start_reader import TASK_WIDTH, FirstStep, Reading, StartReader
from services.world_model.dynamics.tensor_trees import combined, mapped
from services.world_model.predicted_world import observed_start
from services.world_model.settings import ReaderSettings
from services.world_model.training.member_training import read_step, train_reader
from services.world_model.training.scene_table import SceneTable, scene_table, vocabulary

KIND: Final = "direct-judge-2"
# Stores of `make reproduce-checkpoints`, from which the committed state model was trained.
_EPISODES: Final = ("runs/reproduce/train", "runs/reproduce/judge")
_NEEDED: Final = (needs.WHOLE, needs.OUTCOME, needs.TOUCH, needs.OBJECTS, needs.FIRST_IMAGE)
_HIDDEN: Final = 128
_CHECK_EVERY: Final = 100
_BATCH_OF_JUDGING: Final = 128
_QUICK_STEPS: Final = 20


@dataclass(frozen=True)
class Attempts:
    """First observations, what the reader makes of them, and commands up to the end.

    `commands` begin with the measured hands; `counted` marks the latent steps, including that
    first one, which lie within an attempt.
    """

    first: FirstStep
    reading: Reading
    commands: Commands
    counted: Bool[Tensor, "batch latents"]

    @classmethod
    def of(cls, reader: StartReader, table: SceneTable) -> "Attempts":
        """All episodes of a table, from their first step."""
        rows = torch.arange(len(table))
        within = table.within(rows, 0)
        return cls(
            table.first_steps(rows, torch.zeros_like(rows)),
            read_step(reader, table, 0),
            table.commands(rows, 0, torch.zeros(len(rows), dtype=torch.bool)),
            torch.cat([torch.ones_like(within[:, :1]), within], dim=1),
        )


class DirectNetwork(nn.Module):
    """Gated recurrent network on commands relative to the objects that a start reader finds.

    Of the state model that `config` describes, it has the reader only.
    """

    boxes_m: Tensor

    def __init__(self, config: DynamicsConfig) -> None:
        super().__init__()
        self.reader = StartReader(config)
        self.register_buffer("boxes_m", torch.zeros(len(config.tasks), MAX_OBJECTS, 6))
        self.task = nn.Embedding(len(config.tasks), TASK_WIDTH)
        known = 2 * (MAX_OBJECTS * SLOT_SIZE + OWN_SIZE) + TASK_WIDTH
        self.entry = nn.Sequential(nn.Linear(known, _HIDDEN), nn.GELU(), nn.Dropout(0.1))
        self.recurrent = nn.GRU(_HIDDEN, _HIDDEN, batch_first=True)
        self.head = nn.Sequential(
            nn.Dropout(0.2), nn.Linear(2 * _HIDDEN + NUM_PADS, 64), nn.GELU(), nn.Linear(64, 1)
        )

    def forward(self, attempts: Attempts) -> Float32[Tensor, " batch"]:
        """Log odds of success."""
        task, commands, counted = attempts.first.task, attempts.commands, attempts.counted
        num_latents = len(commands)
        objects = attempts.reading.objects
        boxes_m = self.boxes_m[task] * attempts.reading.size[..., BOX_AXES]

        def at_all(values: Tensor) -> Tensor:
            return values.repeat_interleave(num_latents, dim=0)

        near = slot_features(
            commands.points_m.flatten(0, 1),
            at_all(objects.position_m),
            at_all(rotations(objects.axes)),
            at_all(boxes_m),
        )
        near = near * at_all(objects.present)[:, None, :, None]
        wrist_m = commands.points_m[:, :, -1, :, 0]
        own = own_features(commands, torch.cat([wrist_m[:, :1], wrist_m], dim=1))
        known = [
            near.reshape(len(task), num_latents, -1),
            own.flatten(2),
            self.task(task)[:, None].expand(-1, num_latents, -1),
        ]
        states, _ = self.recurrent(self.entry(torch.cat(known, dim=-1)))
        last = states[torch.arange(len(states)), counted.sum(1) - 1]
        # States lie in -1 ... 1.
        highest = states.masked_fill(~counted[..., None], -1.0).amax(1)
        touch = compressed(attempts.first.pads_kpa * 1e-2)
        odds: Tensor = self.head(torch.cat([last, highest, touch], dim=1))
        return odds[:, 0]


class DirectJudge:
    """A trained direct judge, from `load_checkpoint` or from training.

    Raises InvalidInputError if the weights do not match the configuration in the metadata.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.metadata = checkpoint.metadata
        settings = checkpoint.metadata.settings
        self._config = DynamicsConfig.model_validate(settings["config"])
        self._calibrations = {
            task: Calibration.model_validate(values)
            for task, values in settings["calibration"].items()
        }
        self._network = DirectNetwork(self._config)
        load_network(self._network, checkpoint)

    @classmethod
    def load(cls, path: Path) -> "DirectJudge":
        """Load a judge from its file."""
        return cls(load_checkpoint(path, kind=KIND))

    @torch.no_grad()
    def probability(self, start: RolloutStart, actions: Float64[np.ndarray, "steps 67"]) -> float:
        """Calibrated probability that commands (4k steps, relative to the anchor) succeed.

        Raises UnknownNameError for a task that the judge was not trained for, and InvalidInputError
        for no observation, anchor or K_head.
        """
        tasks = self._config.tasks
        seen = observed_start(start, tasks=tasks, image_px=self._config.image_px)
        holding = hand_motion(seen.reached[None], seen.anchor)
        first = first_steps(
            [seen.image], [seen.K_head], [seen.tactile_kpa], [holding], [tasks.index(start.task)]
        )
        parts = [Commands.holding([holding]), Commands.of([hand_motion(actions, seen.anchor)])]
        commands = combined(parts, lambda pair: torch.cat(pair, dim=1))
        counted = torch.ones((1, len(commands)), dtype=torch.bool)
        odds = self._network(Attempts(first, self._network.reader(first), commands, counted))
        calibration = self._calibrations.get(start.task, Calibration())
        return float(calibration.probabilities(odds.double().numpy())[0])


class JudgeSettings(TrainingSettings):
    """Training of a direct judge; the recurrent network stops at its first limit."""

    reader_steps: int = 5000
    num_training_steps: int = 6000
    max_cpu_s: float = 240.0
    batch_size: int = 64
    learning_rate: float = 2e-3
    weight_decay: float = 2e-2
    development_share: float = 0.1


def read_takes(
    urls: Iterable[str], *, tasks: Sequence[str] = ()
) -> tuple[list[EpisodeGrid], set[str]]:
    """True robot episodes of some stores, and the digests of their first observations.

    Raises NotFoundError and ConflictError as `select_episodes`.
    """
    episodes, starts = [], set()
    stores = [EpisodeStore(url) for url in urls]
    for reader in select_episodes(stores, domain="robot", tasks=tasks, needs=_NEEDED):
        first = EpisodeGrid(reader).observation()
        starts.add(start_digest(first.images[HEAD_CAMERA][0], first.tactile_kpa[0]))
        episodes.append(EpisodeGrid(reader, USUAL_IMAGE_PX))
    return episodes, starts


def train_direct_judge(
    episodes: Sequence[EpisodeGrid],
    starts: Iterable[str],
    settings: JudgeSettings,
    *,
    command: str,
) -> Checkpoint:
    """Train a start reader on object poses, then the recurrent network on outcomes.

    A share of the scenes is held out for early stopping, calibration and metrics. The digests of
    the first observations and the command are stored in the checkpoint. Raises InvalidInputError
    for only one outcome, or too few scenes to hold some out.
    """
    share = settings.development_share
    training, apart = split_by_scene(episodes, held_out_share=share, salt="direct judge ")
    if len({one.success for one in training}) < 2:
        raise InvalidInputError(
            f"direct judge: all {len(training)} training episodes have the same outcome, expected "
            "both; record with more noise levels"
        )
    tasks, num_objects = vocabulary(training)
    config = DynamicsConfig(
        tasks=tasks, num_objects=num_objects, image_px=training[0].image_size_px[0]
    )
    learned = scene_table(training, config)
    checked = scene_table([one for one in apart if one.task in tasks], config)
    started_s = time.process_time()
    torch.manual_seed(settings.seed)
    network = DirectNetwork(config)
    network.reader = train_reader(
        learned, config, ReaderSettings(num_steps=settings.reader_steps), seed=settings.seed
    ).requires_grad_(requires_grad=False)
    network.boxes_m.copy_(learned.boxes_m)
    tested = Attempts.of(network.reader, checked)
    sigma_m = reader_sigma_m(tested.reading, checked)
    best = _train(network, learned, sigma_m, (tested, checked.success), settings)
    metrics: dict[str, float] = {
        "training_cpu_s": round(time.process_time() - started_s, 1),
        "num_training_episodes": len(training),
        "num_development_episodes": len(checked),
        "best_step": best,
    }
    for task, sigma in zip(tasks, sigma_m, strict=True):
        metrics[f"reader_sigma_mm_{task}"] = 1e3 * float(sigma[:, :2].max())
    calibration, measured = _calibrated(_log_odds(network, tested), checked, tasks)
    metadata = CheckpointMetadata(
        kind=KIND,
        command=command,
        seed=settings.seed,
        data_hash=data_hash(one.content_sha256 for one in episodes),
        tasks=tasks,
        training_episodes=tuple(one.episode_id for one in episodes),
        training_starts=tuple(sorted(starts)),
        settings={
            "config": config.model_dump(mode="json"),
            "training": settings.model_dump(),
            "calibration": calibration,
        },
        metrics=metrics | measured,
    )
    return Checkpoint(metadata, network_tensors(network))


def reader_sigma_m(reading: Reading, table: SceneTable) -> Float32[Tensor, "tasks objects 3"]:
    """Error of a reader at the first steps, along each axis, as sigma from the median."""
    off_m = (reading.objects.position_m - table.objects.position_m[:, 0]).abs()
    sigma_m = torch.zeros((len(table.boxes_m), MAX_OBJECTS, 3))
    for task in range(len(sigma_m)):
        for slot in range(MAX_OBJECTS):
            mine = off_m[(table.task == task) & table.objects_known[:, 0, slot], slot]
            if len(mine):
                # The median of |x| of a normal distribution is 0.6745 sigma.
                sigma_m[task, slot] = mine.median(dim=0).values / 0.6745
    return sigma_m


def _train(
    network: DirectNetwork,
    table: SceneTable,
    sigma_m: Tensor,
    tested: tuple[Attempts, Tensor],
    settings: JudgeSettings,
) -> int:
    """Minimize the cross entropy; keeps and returns the best step on held-out episodes.

    Steps are checked every hundred; of a shorter run the last one is kept, and 0 is returned.

    Objects are at their true positions with the reader's error on held-out episodes, since it
    errs less on those that it was trained on; where those are unknown, as it reads them.
    """
    attempts = Attempts.of(network.reader, table)

    def loss(generator: torch.Generator) -> Tensor:
        rows = torch.randint(len(table), (settings.batch_size,), generator=generator)
        drawn = mapped(attempts, itemgetter(rows))
        true_m, read = table.objects_at(rows, 0).position_m, drawn.reading.objects
        noise_m = torch.randn(true_m.shape, generator=generator) * sigma_m[drawn.first.task]
        known = table.objects_known[rows, 0][..., None]
        objects = replace(read, position_m=torch.where(known, true_m + noise_m, read.position_m))
        odds = network(replace(drawn, reading=replace(drawn.reading, objects=objects)))
        return binary_cross_entropy_with_logits(odds, table.success[rows])

    least, best, weights = float("inf"), 0, network.state_dict()
    for used in optimized(network, loss, settings, title="direct judge"):
        if used.step % _CHECK_EVERY:
            continue
        odds = _log_odds(network, tested[0])
        network.train()
        error = float(binary_cross_entropy_with_logits(odds, tested[1]))
        if error < least:
            least, best, weights = error, used.step, copy.deepcopy(network.state_dict())
    if best:
        network.load_state_dict(weights)
    return best


@torch.no_grad()
def _log_odds(network: DirectNetwork, attempts: Attempts) -> Float32[Tensor, " batch"]:
    network.eval()
    parts = torch.split(torch.arange(len(attempts.counted)), _BATCH_OF_JUDGING)
    return torch.cat([network(mapped(attempts, itemgetter(rows))) for rows in parts])


def _calibrated(
    log_odds: Tensor, table: SceneTable, tasks: Sequence[str]
) -> tuple[dict[str, Any], dict[str, float]]:
    """Calibration of every task with enough outcomes of both kinds, and its metrics."""
    calibration, metrics = {}, {}
    for index, task in enumerate(tasks):
        mine = table.task == index
        odds = log_odds[mine].double().numpy()
        success = table.success[mine].numpy() > 0.5
        if min(success.sum(), (~success).sum()) < MIN_OUTCOMES:
            continue
        fitted = fit_calibration(odds, success)
        calibration[task] = fitted.model_dump()
        metrics[f"development_auc_{task}"] = area_under_roc(odds, success)
        predicted = fitted.probabilities(odds)
        metrics[f"development_ece_{task}"] = expected_calibration_error(predicted, success)
    return calibration, metrics


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    usual = JudgeSettings()
    add = parser.add_argument
    add("--episodes", nargs="+", default=list(_EPISODES), help="stores to train on (%(default)s)")
    add("--tasks", nargs="+", default=[], help="tasks to train on (all)")
    output = Path("runs/direct_judge.safetensors")
    add("--output", type=Path, default=output, help="checkpoint to write (%(default)s)")
    add("--seed", type=int, default=usual.seed, help="seed of weights and sampling (%(default)s)")
    steps = "training steps of the start reader (%(default)s)"
    add("--reader-steps", type=int, default=usual.reader_steps, help=steps)
    steps = "largest number of steps of the recurrent network (%(default)s)"
    add("--steps", type=int, default=usual.num_training_steps, help=steps)
    cpu_s = "CPU seconds after which the recurrent network stops (%(default)s)"
    add("--cpu-s", type=float, default=usual.max_cpu_s, help=cpu_s)


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Train a judge, write it, and report its metrics on held-out episodes."""
    torch.set_num_threads(1)
    reader_steps, num_steps = options.reader_steps, options.steps
    if options.quick:
        reader_steps, num_steps = min(reader_steps, _QUICK_STEPS), min(num_steps, _QUICK_STEPS)
    limits = {"num_training_steps": num_steps, "max_cpu_s": options.cpu_s}
    settings = JudgeSettings(seed=options.seed, reader_steps=reader_steps, **limits)
    names = [url.rstrip("/").rpartition("/")[2] for url in options.episodes]
    command = shlex.join(["python", "-m", "benchmarks", "direct-judge", "--episodes", *names])
    episodes, starts = read_takes(options.episodes, tasks=options.tasks)
    checkpoint = train_direct_judge(episodes, starts, settings, command=command)
    save_checkpoint(options.output, checkpoint)
    metrics = checkpoint.metadata.metrics
    rows = [(name, f"{value:.4g}") for name, value in metrics.items()]
    return StageReport(
        stage="direct-judge",
        packages=("numpy", "torch"),
        options={"episodes": names, "tasks": options.tasks, "training": settings.model_dump()},
        tables=[ResultTable(f"{options.output}, on held-out episodes", ("", "figure"), rows)],
        requirements=[],
        data={"metrics": metrics},
    )
