"""Training of the joint flow-matching model, from settings to an evaluated checkpoint."""

import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dextouch.errors import ConflictError
from services.networks.optimizer import (
    Budget,
    OptimizerLoop,
    OptimizerOptions,
    half_cosine,
    update_average,
)
from services.world_model.checkpoints import (
    Checkpoint,
    CheckpointMetadata,
    read_checkpoint,
    write_checkpoint,
)
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.network.tactile_tokenizer import TactileTokenizer
from services.world_model.settings import TrainSettings, command_line
from services.world_model.tokenizer_files import StoredTokenizer
from services.world_model.training.dataset import (
    EpisodeArrays,
    Place,
    TrainingEpisode,
    WindowBatch,
    WindowSampler,
    combined_hash,
)
from services.world_model.training.evaluation import evaluate_prediction
from services.world_model.training.frozen_tokenizer import check_unseen, with_tokenizer
from services.world_model.training.objective import losses
from services.world_model.training.splits import (
    check_disjoint,
    check_not_learned,
    check_tasks,
    load_split,
    training_sets,
)
from services.world_model.training.streaming import read_batches
from services.world_model.training.training_state import (
    RunFacts,
    TrainingState,
    identity_of,
    optimizer_tensors,
    part_of,
    read_state,
    restore_optimizer,
    state_path,
    write_state,
)

LOG_EVERY_STEPS = 20
MIN_LEARNING_RATE_SHARE = 0.01


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a run, as a progress bar shows it."""

    step: int
    share: float
    loss_video: float
    loss_tactile: float


@dataclass(frozen=True)
class TrainingReport:
    """Result of a run, with its accuracy on held-out episodes."""

    checkpoint: Path
    digest: str
    num_parameters: int
    steps: int
    cpu_s: float
    num_train_episodes: int
    num_heldout_episodes: int
    metrics: dict[str, float]
    log: list[TrainingProgress] = field(default_factory=list)


OnProgress = Callable[[TrainingProgress], None]
OnState = Callable[["TrainingRun"], None]


def train(settings: TrainSettings, on_progress: OnProgress | None = None) -> TrainingReport:
    """Load episodes, train, write and evaluate the checkpoint.

    Raises:
        InvalidInputError: no episodes, too short ones, or held-out ones among those trained on.
    """
    trained, heldout = load_split(settings)
    return train_on(trained, heldout, settings, on_progress)


def train_on(
    trained: Sequence[TrainingEpisode],
    heldout: Sequence[EpisodeArrays],
    settings: TrainSettings,
    on_progress: OnProgress | None = None,
) -> TrainingReport:
    """`train` with episodes that are already split."""
    check_disjoint(trained, heldout)
    settings, tokenizer = with_tokenizer(settings)
    if tokenizer is not None:
        check_unseen(heldout, tokenizer)
    torch.set_num_threads(settings.num_threads)
    ancestor = None if settings.init is None else read_checkpoint(settings.init)
    check_tasks(trained, heldout, settings, ancestor)
    prints = {episode.content_hash() for episode in trained}
    names = {episode.episode_id for episode in trained}
    if ancestor is not None:
        # Episodes that the initial checkpoint was trained on cannot be held out either.
        check_not_learned(heldout, ancestor)
        prints |= set(ancestor.metadata.train_fingerprints)
        names |= set(ancestor.metadata.train_episode_ids)
    run = TrainingRun(trained, settings)
    log = _run_or_resume(run, ancestor, tokenizer, on_progress)
    metadata = CheckpointMetadata(
        name=settings.name,
        network=settings.network,
        tasks=tuple(sorted({episode.task for episode in trained})),
        command=command_line(settings),
        seed=settings.seed,
        training_steps=run.budget.step,
        training_cpu_s=round(run.budget.cpu_s, 1),
        train_episode_ids=tuple(sorted(names)),
        train_fingerprints=tuple(sorted(prints)),
        data_hash=combined_hash(sorted(prints)),
        heldout_episode_ids=tuple(sorted(episode.episode_id for episode in heldout)),
        initialized_from=None if ancestor is None else ancestor.digest,
        sets=training_sets(
            trained, heldout, human_share=settings.share_of_human, ancestor=ancestor
        ),
        tokenizer_digest=_tokenizer_digest(ancestor, tokenizer),
    )
    write_checkpoint(settings.output, run.averaged, metadata)
    # Evaluate the weights as stored, then store them again with the results.
    stored = read_checkpoint(settings.output).model
    metrics = {
        **evaluate_prediction(
            stored, heldout, train_fingerprints=sorted(prints), stride=settings.evaluation_stride
        )
    }
    digest = write_checkpoint(
        settings.output, stored, metadata.model_copy(update={"metrics": metrics})
    )
    state_path(settings.output).unlink(missing_ok=True)
    return TrainingReport(
        checkpoint=settings.output,
        digest=digest,
        num_parameters=sum(p.numel() for p in stored.parameters()),
        steps=run.budget.step,
        cpu_s=run.budget.cpu_s,
        num_train_episodes=len(trained),
        num_heldout_episodes=len(heldout),
        metrics=metrics,
        log=log,
    )


def _tokenizer_digest(ancestor: Checkpoint | None, tokenizer: StoredTokenizer | None) -> str | None:
    if tokenizer is not None:
        return tokenizer.digest
    return None if ancestor is None else ancestor.metadata.tokenizer_digest


def _run_or_resume(
    run: "TrainingRun",
    ancestor: Checkpoint | None,
    tokenizer: StoredTokenizer | None,
    on_progress: OnProgress | None,
) -> list[TrainingProgress]:
    """Run from the start or resume an interrupted run; saves its state regularly."""
    settings = run.settings
    path = state_path(settings.output)
    identity = identity_of(
        settings,
        data_hash=combined_hash([episode.content_hash() for episode in run.episodes]),
        init_digest=None if ancestor is None else ancestor.digest,
        tokenizer_digest=None if tokenizer is None else tokenizer.digest,
    )
    if settings.resume and path.exists():
        run.restore(read_state(path, identity))
    elif ancestor is not None:
        run.start_from(ancestor)
    else:
        run.fit_codecs(None if tokenizer is None else tokenizer.tokenizer)
    kept_cpu_s = run.budget.cpu_s

    def keep(now: TrainingRun) -> None:
        nonlocal kept_cpu_s
        if now.budget.cpu_s - kept_cpu_s >= settings.state_every_cpu_s:
            tensors, facts = now.state()
            write_state(path, TrainingState(tensors, RunFacts(identity=identity, **facts)))
            kept_cpu_s = now.budget.cpu_s

    return run.run(on_progress, keep)


class TrainingRun:
    """One run: network, weight average, optimizer and clock.

    Windows depend on the seed only, not on whether they are cut in memory or streamed from disk.
    """

    def __init__(self, episodes: Sequence[TrainingEpisode], settings: TrainSettings) -> None:
        self.settings = settings
        self.episodes = episodes
        self.budget = Budget(settings.cpu_budget_s, settings.max_steps)
        self.log: list[TrainingProgress] = []
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.model = JointWorldModel(settings.network)
        self.averaged = JointWorldModel(settings.network).eval()
        self._generator = torch.Generator().manual_seed(settings.seed + 1)
        self._rng = np.random.default_rng(settings.seed + 2)
        # Generator states after the windows trained on, and after those read ahead.
        self._window_numbers = json.dumps(self._rng.bit_generator.state)
        self._drawn: deque[str] = deque()
        windows = settings.windows
        self._sampler = WindowSampler(
            episodes,
            self._rng,
            max_steps=settings.network.max_steps,
            commanded_fraction=windows.commanded_fraction,
            chained_fraction=windows.chained_fraction,
            human_share=settings.share_of_human,
        )
        options = OptimizerOptions(
            learning_rate=settings.optimizer.learning_rate,
            weight_decay=settings.optimizer.weight_decay,
            max_gradient_norm=settings.optimizer.max_gradient_norm,
            warmup_steps=settings.optimizer.warmup_steps,
            schedule=partial(half_cosine, least=MIN_LEARNING_RATE_SHARE),
            betas=(0.9, 0.95),
        )
        self.loop = OptimizerLoop(self.model, options, self.budget)

    @torch.no_grad()
    def fit_codecs(self, tokenizer: TactileTokenizer | None = None) -> None:
        """Fit everything in closed form: codecs, action statistics, residual scales.

        Args:
            tokenizer: pretrained tokenizer to use instead of fitting one.
        """
        model, config = self.model, self.settings.network
        batch = self._sampler.draw(self.settings.windows.fit_windows, config.max_steps)
        model.codec.fit(batch.images)
        if tokenizer is None:
            model.tokenizer.fit(batch.tactile_kpa.flatten(0, 1))
        else:
            model.tokenizer.load_state_dict(tokenizer.state_dict())
            model.tokenizer.peak_kpa.clamp_min_(batch.tactile_kpa.max())
        model.normalizer.fit(build_inputs(batch.requests, config).hands)
        targets = model.targets(batch.images, batch.tactile_kpa)
        model.video_residual_std.copy_(targets.video[:, 1:].std().clamp_min(1e-3))
        if config.use_touch:
            model.tactile_residual_std.copy_(targets.tactile[:, 1:].std().clamp_min(1e-3))
        self.averaged.load_state_dict(model.state_dict())

    def start_from(self, checkpoint: Checkpoint) -> None:
        """Take over the weights and codecs of a checkpoint.

        Raises:
            ConflictError: the checkpoint has other network settings; they are named.
        """
        requested = self.settings.network.model_dump()
        there = checkpoint.metadata.network.model_dump()
        others = {
            name: (there[name], requested[name])
            for name in requested
            if there[name] != requested[name]
        }
        if others:
            raise ConflictError(
                "training: the initial checkpoint has other network settings (stored, "
                f"requested): {others}; request the stored ones"
            )
        self.model.load_state_dict(checkpoint.model.state_dict())
        self.averaged.load_state_dict(checkpoint.model.state_dict())

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and metadata that the next steps depend on."""
        tensors = {f"model.{n}": t for n, t in self.model.state_dict().items()}
        tensors |= {f"averaged.{n}": t for n, t in self.averaged.state_dict().items()}
        tensors |= optimizer_tensors(self.loop.optimizer)
        tensors["generator"] = self._generator.get_state()
        facts = {
            "step": self.budget.step,
            "cpu_s": self.budget.cpu_s,
            "window_numbers": self._window_numbers,
            "log": tuple(astuple(entry) for entry in self.log),
        }
        return tensors, facts

    def restore(self, state: TrainingState) -> None:
        """Continue from `state`."""
        self.model.load_state_dict(part_of(state.tensors, "model."))
        self.averaged.load_state_dict(part_of(state.tensors, "averaged."))
        restore_optimizer(self.loop.optimizer, state.tensors)
        self._generator.set_state(state.tensors["generator"])
        self._window_numbers = state.facts.window_numbers
        self._rng.bit_generator.state = json.loads(self._window_numbers)
        self.budget.step, self.budget.cpu_s = state.facts.step, state.facts.cpu_s
        self.log = [TrainingProgress(*row) for row in state.facts.log]

    def run(
        self, on_progress: OnProgress | None = None, on_step: OnState | None = None
    ) -> list[TrainingProgress]:
        """Train until the budget or the number of steps is used up; returns the loss log.

        Args:
            on_progress: called with every entry of the log.
            on_step: called with the run after every step.
        """
        budget = self.budget
        budget.start()
        self.model.train()
        batches = self._batches()
        while budget.share() < 1.0:
            loss_video, loss_tactile = self.learn(next(batches))
            self._window_numbers = self._drawn.popleft()
            budget.advance()
            if budget.step % LOG_EVERY_STEPS == 0 or budget.share() >= 1.0:
                progress = TrainingProgress(
                    budget.step, min(budget.share(), 1.0), loss_video, loss_tactile
                )
                self.log.append(progress)
                if on_progress is not None:
                    on_progress(progress)
            if on_step is not None:
                on_step(self)
        return self.log

    def learn(self, batch: WindowBatch) -> tuple[float, float]:
        """One optimizer step; returns the video and tactile losses."""
        settings = self.settings.optimizer
        inputs = build_inputs(batch.requests, self.settings.network)
        loss = losses(
            self.model,
            inputs,
            batch,
            generator=self._generator,
            context_noise=self.settings.windows.context_noise,
            touch_loss=settings.touch_loss,
        )
        total = loss.video + settings.tactile_weight * loss.tactile
        self.loop.learn(total, video=loss.video, touch=loss.tactile)
        update_average(
            self.averaged, self.model, decay=settings.ema_decay, num_updates=self.budget.step
        )
        return loss.video.item(), loss.tactile.item()

    def _batches(self) -> Iterator[WindowBatch]:
        """Endless iterator over the windows of each step."""
        if self.settings.streaming:
            workers = self.settings.loader_workers
            return read_batches(self.episodes, self._noted_places(), num_workers=workers)
        return map(self._sampler.cut, self._noted_places())

    def _noted_places(self) -> Iterator[list[Place]]:
        """`places`, recording the generator state after each, since readers fetch ahead."""
        for places in self.places():
            self._drawn.append(json.dumps(self._rng.bit_generator.state))
            yield places

    def places(self) -> Iterator[list[Place]]:
        """Endless iterator over the places of the windows of each step."""
        while True:
            yield self._sampler.places(self.settings.optimizer.batch, self._num_steps())

    def _num_steps(self) -> int:
        """Mostly the full window; sometimes 5, 9, … steps, since short chunks are served, too."""
        longest = self.settings.network.max_steps
        if self._rng.random() >= self.settings.windows.short_fraction:
            return longest
        return int(self._rng.choice(np.arange(5, longest + 1, 4)))
