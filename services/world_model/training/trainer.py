"""Training settings in, a measured checkpoint and a report out."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from dextouch.errors import InvalidInputError
from services.world_model.checkpoints import (
    CheckpointMetadata,
    read_checkpoint,
    write_checkpoint,
)
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.settings import OptimizerSettings, TrainSettings, command_line
from services.world_model.training.dataset import (
    EpisodeArrays,
    Place,
    TrainingEpisode,
    WindowBatch,
    WindowSampler,
    combined_hash,
)
from services.world_model.training.episodes import load_episodes, split_by_hash
from services.world_model.training.evaluation import evaluate_prediction
from services.world_model.training.objective import losses
from services.world_model.training.streaming import index_episodes, read_batches

LOG_EVERY_STEPS = 20
MIN_LEARNING_RATE_SHARE = 0.01


@dataclass(frozen=True)
class TrainingProgress:
    """Where a run stands: what a progress bar needs."""

    step: int
    share: float
    loss_video: float
    loss_tactile: float


@dataclass(frozen=True)
class TrainingReport:
    """What a run made and how good it is on held-out episodes."""

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


def train(settings: TrainSettings, on_progress: OnProgress | None = None) -> TrainingReport:
    """Load episodes, train, store, and measure what was stored.

    Raises:
        InvalidInputError: no episodes, too short ones, or held-out ones among those trained on.
    """
    trained, heldout = load_split(settings)
    return train_on(trained, heldout, settings, on_progress)


def load_split(
    settings: TrainSettings,
) -> tuple[Sequence[TrainingEpisode], list[EpisodeArrays]]:
    """Training and held-out episodes of the settings' stores; the latter always in memory."""
    if settings.streaming:
        return _stream_split(settings)
    episodes = load_episodes(settings.episodes)
    if settings.heldout is None:
        return split_by_hash(episodes, heldout_percent=settings.heldout_percent)
    return episodes, load_episodes(settings.heldout)


def _stream_split(
    settings: TrainSettings,
) -> tuple[Sequence[TrainingEpisode], list[EpisodeArrays]]:
    episodes = index_episodes(settings.episodes)
    if settings.heldout is not None:
        return episodes, load_episodes(settings.heldout)
    trained, heldout = split_by_hash(episodes, heldout_percent=settings.heldout_percent)
    return trained, [episode.load() for episode in heldout]


def train_on(
    trained: Sequence[TrainingEpisode],
    heldout: Sequence[EpisodeArrays],
    settings: TrainSettings,
    on_progress: OnProgress | None = None,
) -> TrainingReport:
    """`train` with episodes that are already split."""
    check_disjoint(trained, heldout)
    torch.set_num_threads(settings.num_threads)
    run = TrainingRun(trained, settings)
    run.fit_codecs()
    log = run.run(on_progress)
    prints = sorted(episode.content_hash() for episode in trained)
    metadata = CheckpointMetadata(
        name=settings.name,
        network=settings.network,
        tasks=tuple(sorted({episode.task for episode in trained})),
        command=command_line(settings),
        seed=settings.seed,
        training_steps=run.step,
        training_cpu_s=round(run.cpu_s, 1),
        train_episode_ids=tuple(sorted(episode.episode_id for episode in trained)),
        train_fingerprints=tuple(prints),
        data_hash=combined_hash(prints),
        heldout_episode_ids=tuple(sorted(episode.episode_id for episode in heldout)),
    )
    write_checkpoint(settings.output, run.averaged, metadata)
    # Measured on the weights as stored, then stored again with the figures.
    stored = read_checkpoint(settings.output).model
    metrics = {
        **evaluate_prediction(
            stored, heldout, train_fingerprints=prints, stride=settings.evaluation_stride
        )
    }
    digest = write_checkpoint(
        settings.output, stored, metadata.model_copy(update={"metrics": metrics})
    )
    return TrainingReport(
        checkpoint=settings.output,
        digest=digest,
        num_parameters=sum(p.numel() for p in stored.parameters()),
        steps=run.step,
        cpu_s=run.cpu_s,
        num_train_episodes=len(trained),
        num_heldout_episodes=len(heldout),
        metrics=metrics,
        log=log,
    )


def check_disjoint(trained: Sequence[TrainingEpisode], heldout: Sequence[TrainingEpisode]) -> None:
    """Raise if a held-out episode, or a seed of its task, is also trained on."""
    prints = {episode.content_hash() for episode in trained}
    seeds = {(e.task, e.seed) for e in trained if e.seed is not None}
    both = [
        episode.episode_id
        for episode in heldout
        if episode.content_hash() in prints or (episode.task, episode.seed) in seeds
    ]
    if both:
        raise InvalidInputError(
            f"training: {len(both)} held-out episodes are also trained on {both[:3]} (same content "
            "or same task and seed); expected disjoint sets",
            episodes=both,
        )


class TrainingRun:
    """One run: network, its running average, optimizer and clock.

    Windows of a seed are the same ones whether they are cut in memory or streamed from the disk.
    """

    def __init__(self, episodes: Sequence[TrainingEpisode], settings: TrainSettings) -> None:
        self.settings = settings
        self._episodes = episodes
        self.step = 0
        self.cpu_s = 0.0
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.model = JointWorldModel(settings.network)
        self.averaged = JointWorldModel(settings.network).eval()
        self._generator = torch.Generator().manual_seed(settings.seed + 1)
        self._rng = np.random.default_rng(settings.seed + 2)
        windows = settings.windows
        self._sampler = WindowSampler(
            episodes,
            self._rng,
            max_steps=settings.network.max_steps,
            commanded_fraction=windows.commanded_fraction,
            chained_fraction=windows.chained_fraction,
        )
        self._optimizer = torch.optim.AdamW(
            self.model.parameters(),
            lr=settings.optimizer.learning_rate,
            weight_decay=settings.optimizer.weight_decay,
            betas=(0.9, 0.95),
            fused=True,
        )

    @torch.no_grad()
    def fit_codecs(self) -> None:
        """Fit everything that is closed form: codecs, action statistics, residual scales."""
        model, config = self.model, self.settings.network
        batch = self._sampler.draw(self.settings.windows.fit_windows, config.max_steps)
        model.codec.fit(batch.images)
        model.tokenizer.fit(batch.tactile_kpa.flatten(0, 1))
        model.normalizer.fit(build_inputs(batch.requests, config).hands)
        residuals = model.residuals(batch.images, batch.tactile_kpa)
        model.video_residual_std.copy_(residuals.video[:, 1:].std().clamp_min(1e-3))
        model.tactile_residual_std.copy_(residuals.tactile[:, 1:].std().clamp_min(1e-3))
        self.averaged.load_state_dict(model.state_dict())

    def run(self, on_progress: OnProgress | None = None) -> list[TrainingProgress]:
        """Train until the budget or the number of steps is used up; returns the loss log."""
        log: list[TrainingProgress] = []
        start_s = time.process_time()
        self.model.train()
        batches = self._batches()
        while self.share() < 1.0:
            loss_video, loss_tactile = self.learn(next(batches))
            self.step += 1
            self.cpu_s = time.process_time() - start_s
            if self.step % LOG_EVERY_STEPS == 0 or self.share() >= 1.0:
                progress = TrainingProgress(
                    self.step, min(self.share(), 1.0), loss_video, loss_tactile
                )
                log.append(progress)
                if on_progress is not None:
                    on_progress(progress)
        return log

    def share(self) -> float:
        """Share of the run that is done, by the tighter of its two limits."""
        by_time = self.cpu_s / self.settings.cpu_budget_s
        limit = self.settings.max_steps
        return by_time if limit is None else max(by_time, self.step / limit)

    def learn(self, batch: WindowBatch) -> tuple[float, float]:
        """One step of the optimizer; the losses of sight and touch come back."""
        settings = self.settings.optimizer
        inputs = build_inputs(batch.requests, self.settings.network)
        loss = losses(
            self.model,
            inputs,
            batch,
            generator=self._generator,
            context_noise=self.settings.windows.context_noise,
        )
        for group in self._optimizer.param_groups:
            group["lr"] = learning_rate(settings, self.step, self.share())
        self._optimizer.zero_grad()
        torch.autograd.backward(loss.video + settings.tactile_weight * loss.tactile)
        torch.nn.utils.clip_grad_norm_(
            self.model.parameters(), settings.max_gradient_norm, error_if_nonfinite=True
        )
        self._optimizer.step()
        self._average()
        return loss.video.item(), loss.tactile.item()

    def _batches(self) -> Iterator[WindowBatch]:
        """The windows of each step, for ever."""
        if self.settings.streaming:
            workers = self.settings.loader_workers
            return read_batches(self._episodes, self.places(), num_workers=workers)
        return map(self._sampler.cut, self.places())

    def places(self) -> Iterator[list[Place]]:
        """Where the windows of each step lie, for ever."""
        while True:
            yield self._sampler.places(self.settings.optimizer.batch, self._num_steps())

    def _num_steps(self) -> int:
        """Mostly the full window; sometimes 5, 9, … steps, since short chunks are served too."""
        longest = self.settings.network.max_steps
        if self._rng.random() >= self.settings.windows.short_fraction:
            return longest
        return int(self._rng.choice(np.arange(5, longest + 1, 4)))

    @torch.no_grad()
    def _average(self) -> None:
        # Early weights are forgotten faster, so that short runs are not held back by the start.
        decay = min(self.settings.optimizer.ema_decay, (1 + self.step) / (10 + self.step))
        for mean, weight in zip(self.averaged.parameters(), self.model.parameters(), strict=True):
            mean.lerp_(weight, 1.0 - decay)


def learning_rate(settings: OptimizerSettings, step: int, share: float) -> float:
    """Linear warm-up, then half a cosine over the share of the run that is done."""
    warmup = min(1.0, (step + 1) / settings.warmup_steps)
    cosine = 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0)))
    return settings.learning_rate * warmup * max(cosine, MIN_LEARNING_RATE_SHARE)
