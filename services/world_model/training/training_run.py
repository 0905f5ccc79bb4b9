"""One training run of the joint model: its network, weight average, optimizer and clock."""

import copy
import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dextouch.errors import ConflictError
from services.networks.memory import on_device
from services.networks.optimizer import (
    Budget,
    OptimizerLoop,
    OptimizerOptions,
    half_cosine,
    update_average,
)
from services.world_model.checkpoints import (
    Checkpoint,
)
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.network.tactile_tokenizer import TactileTokenizer
from services.world_model.pretrained_video import initial_model, share_texts
from services.world_model.settings import TrainSettings
from services.world_model.training.dataset import (
    TrainingEpisode,
    WindowBatch,
    WindowPosition,
    WindowSampler,
)
from services.world_model.training.distribution import (
    ALONE,
    Processes,
    load_whole,
    whole_weights,
)
from services.world_model.training.objective import LossOptions, losses
from services.world_model.training.self_forcing import own_context
from services.world_model.training.streaming import read_batches
from services.world_model.training.training_state import (
    TrainingState,
    moments_like,
    optimizer_tensors,
    part_of,
    restore_optimizer,
)
from services.world_model.wan.configuration import WanFiles

LOG_EVERY_STEPS = 20
MIN_LEARNING_RATE_SHARE = 0.01


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a run, as a progress bar shows it."""

    step: int
    share: float
    loss_video: float
    loss_tactile: float


OnProgress = Callable[[TrainingProgress], None]
OnState = Callable[["TrainingRun"], None]


class TrainingRun:
    """One run: network, weight average, optimizer and clock.

    Windows depend on the seed only, not on whether they are cut in memory or streamed from disk.
    """

    def __init__(
        self,
        episodes: Sequence[TrainingEpisode],
        settings: TrainSettings,
        processes: Processes = ALONE,
    ) -> None:
        processes.check_batch(settings.optimizer.batch)
        processes.check_device(settings.device)
        self.settings = settings
        self.episodes = episodes
        self.processes = processes
        self.budget = Budget(settings.cpu_budget_s, settings.max_steps)
        self.log: list[TrainingProgress] = []
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            has_weights = settings.init is not None or settings.resume
            model = initial_model(settings.network, settings.wan, filled_later=has_weights)
        self.model = on_device(model, settings.device)
        self.averaged = copy.deepcopy(self.model).eval()
        for network in (self.model, self.averaged):
            processes.shard(network, network.layers)
        self._generator = torch.Generator().manual_seed(settings.seed + 1)
        self._rng = np.random.default_rng(settings.seed + 2)
        # Generator states after the windows trained on, and after those read ahead.
        self._window_numbers = json.dumps(self._rng.bit_generator.state)
        self._drawn: deque[str] = deque()
        windows = settings.windows
        self._sampler = WindowSampler(
            episodes,
            self._rng,
            max_steps=self._window_steps(settings.network.max_steps),
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
        if model.device.type != "cpu":
            model.cpu()
        batch = self._sampler.draw(self.settings.windows.fit_windows, config.max_steps)
        model.codec.fit(batch.images)
        if tokenizer is None:
            model.tokenizer.fit(batch.tactile_kpa.flatten(0, 1))
        else:
            model.tokenizer.load_state_dict(tokenizer.state_dict())
            model.tokenizer.peak_kpa.clamp_min_(batch.tactile_kpa.max())
        model.normalizer.fit(build_inputs(batch.requests, config).hands)
        # The pretrained expert takes its latents as they are.
        if config.wan is None:
            videos = model.targets(batch.images, batch.tactile_kpa).video
            model.video_residual_std.copy_(videos[:, 1:].std().clamp_min(1e-3))
        if config.use_touch:
            touch = model.tactile_targets(batch.tactile_kpa)
            model.tactile_residual_std.copy_(touch[:, 1:].std().clamp_min(1e-3))
        if self.settings.device != "cpu":
            on_device(model, self.settings.device)
        self.averaged.load_state_dict(model.state_dict())

    def start_from(self, checkpoint: Checkpoint) -> None:
        """Take over the weights and codecs of a checkpoint.

        Raises:
            ConflictError: the checkpoint has other network settings; they are named.
        """
        sampling = {"sampling_steps", "sampler", "sampling_time_shift"}
        requested = self.settings.network.model_dump(exclude=sampling)
        there = checkpoint.metadata.network.model_dump(exclude=sampling)
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
        load_whole(self.model, checkpoint.model.state_dict())
        load_whole(self.averaged, checkpoint.model.state_dict())
        share_texts(checkpoint.model, self.model)

    def whole_average(self) -> JointWorldModel | None:
        """The averaged network with whole weights; None in all processes but the first."""
        if self.processes.mesh is None:
            return self.averaged
        weights = whole_weights(self.averaged)
        if not self.processes.is_first:
            return None
        model = initial_model(self.settings.network, WanFiles(), filled_later=True).eval()
        model.load_state_dict(weights)
        share_texts(self.model, model)
        return model

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

    def like_state(self) -> dict[str, Tensor]:
        """Tensors with the names, shapes and sharding of those of a state after a step."""
        return {**moments_like(self.loop.optimizer), **self.state()[0]}

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
            budget.cpu_s = self.processes.mean(torch.tensor(budget.cpu_s)).item()
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
        if self.settings.self_forcing:
            batch = own_context(
                self.model, batch, generator=self._generator, processes=self.processes
            )
        loss = losses(
            self.model,
            batch,
            generator=self._generator,
            options=LossOptions(
                self.settings.windows.context_noise,
                settings.touch_loss,
                settings.precision,
                own_noisy=self.settings.self_forcing,
            ),
            processes=self.processes,
        )
        total = loss.video + settings.tactile_weight * loss.tactile
        self.loop.learn(total, video=loss.video, touch=loss.tactile)
        update_average(
            self.averaged, self.model, decay=settings.ema_decay, num_updates=self.budget.step
        )
        video, tactile = self.processes.mean(torch.stack([loss.video, loss.tactile])).tolist()
        return video, tactile

    def _batches(self) -> Iterator[WindowBatch]:
        """Endless iterator over the windows of each step."""
        if self.settings.streaming:
            workers = self.settings.loader_workers
            return read_batches(self.episodes, self._noted_places(), num_workers=workers)
        return map(self._sampler.cut, self._noted_places())

    def _noted_places(self) -> Iterator[list[WindowPosition]]:
        """`places`, recording the generator state after each, since readers fetch ahead."""
        for places in self.places():
            self._drawn.append(json.dumps(self._rng.bit_generator.state))
            yield self.processes.part(places)

    def places(self) -> Iterator[list[WindowPosition]]:
        """Endless iterator over the places of the windows of each step."""
        while True:
            num_steps = self._window_steps(self._num_steps())
            yield self._sampler.places(self.settings.optimizer.batch, num_steps)

    def _window_steps(self, num_steps: int) -> int:
        """Steps of a window of one chunk, or of two for self-forcing."""
        return 2 * num_steps - 1 if self.settings.self_forcing else num_steps

    def _num_steps(self) -> int:
        """Mostly the full window; sometimes 5, 9, … steps, since short chunks are served, too."""
        longest = self.settings.network.max_steps
        if self._rng.random() >= self.settings.windows.short_fraction:
            return longest
        return int(self._rng.choice(np.arange(5, longest + 1, 4)))
