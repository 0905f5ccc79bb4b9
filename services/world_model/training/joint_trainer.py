"""Training of the joint flow-matching model, from settings to an evaluated checkpoint."""

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import UInt8
from pydantic import JsonValue
from torch import Tensor

from dextouch.episodes import data_hash
from dextouch.errors import ConflictError
from dextouch.tactile.layout import common_layout
from services.networks import optimizer
from services.networks.weight_files import on_device
from services.world_model import checkpoints
from services.world_model.network.codecs import to_unit
from services.world_model.network.configuration import NetworkConfig, WanFiles, num_latents
from services.world_model.network.inputs import PastRule, build_inputs
from services.world_model.network.model import JointWorldModel, from_first
from services.world_model.network.tactile import TactileTokenizer
from services.world_model.paper_settings import TrainSettings, command_line
from services.world_model.pretrained_video import (
    freeze_pretrained,
    initial_model,
    is_pretrained,
    share_texts,
)
from services.world_model.training import episode_sets, joint_dataset, joint_objective, resume_files
from services.world_model.training.distribution import ALONE, Processes, load_whole, whole_weights
from services.world_model.training.evaluation import (
    evaluate_prediction,
    evaluated_places,
    refuse_trained,
)
from services.world_model.training.latent_cache import use_latent_cache
from services.world_model.training.tokenizer_trainer import check_unseen, with_tokenizer

# Chosen: four steps of a path at first, 128 at the end.
_FIRST_CONSISTENCY_STEPS: Final = 4
LOG_EVERY_STEPS = 20  # rows of a report's `log`, kept for resumed runs, too


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
    """One run: network, averages of its learned weights, optimizer and clock.

    Windows depend on the seed only. Averages that would equal the weights are not kept.
    """

    def __init__(
        self,
        episodes: Sequence[joint_dataset.TrainingEpisode],
        settings: TrainSettings,
        processes: Processes = ALONE,
    ) -> None:
        processes.check(settings.optimizer.batch, settings.accumulate)
        self.settings = settings
        self.episodes = episodes
        self.processes = processes
        self.budget = optimizer.Budget(
            settings.cpu_budget_s or math.inf,
            settings.step_limit,
            settings.wall_budget_s or math.inf,
            paced_by_steps=True,
        )
        self.log: list[TrainingProgress] = []
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            is_filled = settings.init is not None
            model = initial_model(
                settings.network, settings.wan, filled_later=is_filled, prepare=self._prepare
            )
        # Sharded weights are there already.
        is_alone = processes.mesh is None
        self.model = on_device(model, settings.device) if is_alone else model.to(settings.device)
        self.learned = optimizer.learned_weights(self.model)
        self._averages: dict[str, Tensor] = {}
        self._start_averages()
        self._generator = torch.Generator().manual_seed(settings.seed + 1)
        self._rng = np.random.default_rng(settings.seed + 2)
        # Generator states after the windows trained on, and after those read ahead.
        self._window_numbers = json.dumps(self._rng.bit_generator.state)
        self._drawn: deque[str] = deque()
        self._sampler = joint_dataset.WindowSampler(
            episodes,
            self._rng,
            max_steps=self._window_steps(settings.network.max_steps),
            human_share=settings.share_of_human,
            past=PastRule.of(settings.network),
            dropout=(settings.windows.past_dropout, settings.windows.view_dropout),
        )
        options = settings.optimizer.options()
        self.loop = optimizer.OptimizerLoop(self.model, options, self.budget)

    def _prepare(self, model: JointWorldModel) -> None:
        """Freeze, shard and so on, before there is memory for the weights."""
        settings, wan = self.settings, self.settings.network.wan
        if settings.freeze_video or (wan is not None and wan.lora_rank):
            freeze_pretrained(model)
        for layer in model.joint_layers():
            layer.recompute = settings.recompute
        self.processes.shard(model, model.layers, whole=(model.codec, model.tokenizer))

    def _start_averages(self) -> None:
        if self.settings.optimizer.ema_decay > 0.0:
            self._averages = {name: one.detach().clone() for name, one in self.learned.items()}

    @torch.no_grad()
    def fit_codecs(self, tokenizer: TactileTokenizer | None = None) -> None:
        """Fit codecs, unless a tokenizer is given, action statistics and residual scales."""
        model, config = self.model, self.settings.network
        fitted = [model.tokenizer, model.normalizer, *([] if config.wan else [model.codec])]
        for part in fitted:
            part.cpu()
        batch = self._sampler.draw(self.settings.windows.fit_windows, config.max_steps)
        model.codec.fit(_all_views(batch))
        if tokenizer is None:
            model.tokenizer.fit(batch.tactile_kpa.flatten(0, 1))
        else:
            model.tokenizer.load_state_dict(tokenizer.state_dict())
            model.tokenizer.peak_kpa.clamp_min_(batch.tactile_kpa.max())
        model.normalizer.fit(build_inputs(batch.requests, config).hands)
        # The pretrained expert takes its latents as they are.
        if config.wan is None:
            videos = from_first(model.codec.encode(to_unit(_all_views(batch))), config.video_target)
            model.video_residual_std.copy_(videos[:, 1:].std().clamp_min(1e-3))
        if config.use_touch:
            touch = from_first(model.tokenizer.encode(batch.tactile_kpa), config.tactile_target)
            model.tactile_residual_std.copy_(touch[:, 1:].std().clamp_min(1e-3))
        for part in fitted:
            part.to(model.device)

    def start_from(self, checkpoint: checkpoints.Checkpoint) -> None:
        """Take over the weights and codecs of a checkpoint; unequal adapters are merged.

        Raises:
            ConflictError: the checkpoint has other network settings; they are named.
        """
        common_layout(
            [checkpoint.metadata.network.tactile_layout, self.settings.network.tactile_layout],
            what="--init and the training episodes",
        )
        own, stored = self.settings.network, checkpoint.metadata.network
        free: Any = {
            **dict.fromkeys(("sampling_steps", "sampler", "sampling_time_shift", "layout"), True),
            "wan": {"precision", "lora_rank", "lora_scale"},
        }
        requested, there = own.model_dump(exclude=free), stored.model_dump(exclude=free)
        others = {
            name: (there.get(name), requested.get(name))
            for name in {**requested, **there}
            if there.get(name) != requested.get(name)
        }
        if others:
            raise ConflictError(
                "training: the initial checkpoint has other network settings (stored, "
                f"requested): {others}; request the stored ones"
            )
        if stored.adapters != own.adapters:
            checkpoint.model.merge_adapters()
        load_whole(self.model, checkpoint.model.state_dict())
        self._start_averages()
        share_texts(checkpoint.model, self.model)

    @torch.no_grad()
    def whole_average(self) -> JointWorldModel | None:
        """The averaged network, its adapters merged unless kept; None in other processes."""
        for name, average in self._averages.items():
            self.learned[name].copy_(average)
        model = self.model
        if self.processes.mesh is not None:
            weights = whole_weights(model)
            if not self.processes.is_first:
                return None
            model = initial_model(self.settings.network, WanFiles(), filled_later=True)
            model.load_state_dict(weights)
            share_texts(self.model, model)
        if not self.settings.lora.keep:
            model.merge_adapters()
        return model.eval()

    def state(self, identity: dict[str, JsonValue]) -> resume_files.TrainingState:
        """Tensors and metadata that the next steps depend on."""
        named = self.model.named_parameters()
        given = {n for n, one in named if is_pretrained(n) and not one.requires_grad}
        tensors = {f"model.{n}": t for n, t in self.model.state_dict().items() if n not in given}
        tensors |= {f"averaged.{n}": t for n, t in self._averages.items()}
        tensors |= resume_files.optimizer_tensors(self.loop.optimizer, self.learned)
        tensors["generator"] = self._generator.get_state()
        facts = resume_files.RunFacts(
            identity=identity,
            step=self.budget.step,
            cpu_s=self.budget.cpu_s,
            wall_s=self.budget.wall_s,
            window_numbers=self._window_numbers,
            log=tuple(astuple(entry) for entry in self.log),
        )
        return resume_files.TrainingState(tensors, facts)

    def restore(self, state: resume_files.TrainingState) -> None:
        """Continue from `state`."""
        weights = resume_files.part_of(state.tensors, "model.")
        self.model.load_state_dict(weights, strict=False)
        self._averages = {
            name: average.to(self.model.device)
            for name, average in resume_files.part_of(state.tensors, "averaged.").items()
        }
        resume_files.restore_optimizer(self.loop.optimizer, self.learned, state.tensors)
        self._generator.set_state(state.tensors["generator"])
        self._window_numbers = state.facts.window_numbers
        self._rng.bit_generator.state = json.loads(self._window_numbers)
        facts, budget = state.facts, self.budget
        budget.step, budget.cpu_s, budget.wall_s = facts.step, facts.cpu_s, facts.wall_s
        self.log = [TrainingProgress(*row) for row in state.facts.log]

    def run(
        self, on_progress: OnProgress | None = None, on_step: OnState | None = None
    ) -> list[TrainingProgress]:
        """Train until a limit; returns the loss log, of which `on_progress` gets each entry."""
        budget = self.budget
        budget.start()
        self.model.train()
        batches = self._batches()
        while budget.share() < 1.0:
            loss_video, loss_tactile = self.learn(next(batches))
            self._window_numbers = self._drawn.popleft()
            budget.advance()
            spent = torch.tensor([budget.cpu_s, budget.wall_s], dtype=torch.float64)
            budget.cpu_s, budget.wall_s = self.processes.mean(spent).tolist()
            if budget.step % LOG_EVERY_STEPS == 0 or budget.share() >= 1.0:
                share = min(budget.share(), 1.0)
                progress = TrainingProgress(budget.step, share, loss_video, loss_tactile)
                self.log.append(progress)
                if on_progress is not None:
                    on_progress(progress)
            if on_step is not None:
                on_step(self)
        return self.log

    def learn(self, batch: joint_dataset.WindowBatch) -> tuple[float, float]:
        """One optimizer step; returns the video and tactile losses."""
        settings, num_parts = self.settings.optimizer, self.settings.accumulate
        if self.settings.self_forcing:
            batch = joint_objective.own_context(
                self.model, batch, generator=self._generator, processes=self.processes
            )
        windows = self.settings.windows
        options = joint_objective.LossOptions(
            windows.context_noise,
            settings.touch_loss,
            settings.precision,
            own_noisy=self.settings.self_forcing and not self.settings.consistency,
            consistency_steps=self._consistency_steps(),
            text_dropout=windows.text_dropout,
            action_dropout=windows.action_dropout,
        )
        examples = joint_objective.examples_of(
            self.model,
            batch,
            generator=self._generator,
            options=options,
            processes=self.processes,
            num_parts=num_parts,
        )
        self.loop.optimizer.zero_grad()
        both = torch.zeros(2, device=examples.t.device)
        for part in examples.parts(num_parts):
            loss = joint_objective.errors(self.model, part, settings.precision)
            torch.autograd.backward(loss.video + settings.tactile_weight * loss.tactile)
            both += torch.stack([loss.video, loss.tactile]).detach()
        self.loop.step(video=both[0], touch=both[1])
        averages = self._averages
        weights = [self.learned[name] for name in averages]
        optimizer.update_average(
            averages.values(), weights, decay=settings.ema_decay, num_updates=self.budget.step
        )
        video, tactile = self.processes.mean(both).tolist()
        return video, tactile

    def _consistency_steps(self) -> int | None:
        """Steps of the paths, which double five times: from low variance to low bias."""
        if not self.settings.consistency:
            return None
        return _FIRST_CONSISTENCY_STEPS * 2 ** min(5, int(6 * self.budget.share()))

    def _batches(self) -> Iterator[joint_dataset.WindowBatch]:
        places = self._noted_places()
        if self.settings.streaming:
            workers = self.settings.loader_workers
            return joint_dataset.read_batches(self.episodes, places, num_workers=workers)
        return map(self._sampler.cut, places)

    def _noted_places(self) -> Iterator[list[joint_dataset.WindowPosition]]:
        """`places`, recording the generator state after each, since readers fetch ahead."""
        for places in self.places():
            self._drawn.append(json.dumps(self._rng.bit_generator.state))
            yield self.processes.own(places)

    def places(self) -> Iterator[list[joint_dataset.WindowPosition]]:
        """Endless iterator over the places of the windows of each step."""
        longest, rng = self.settings.network.max_steps, self._rng
        while True:
            num_steps = longest
            # Sometimes 5, 9, … steps, since short chunks are served, too.
            if rng.random() < self.settings.windows.short_fraction:
                num_steps = int(rng.choice(np.arange(5, longest + 1, 4)))
            batch = self.settings.optimizer.batch
            yield self._sampler.places(batch, self._window_steps(num_steps))

    def _window_steps(self, num_steps: int) -> int:
        """Steps of a window of one chunk, or of two for self-forcing."""
        return 2 * num_steps - 1 if self.settings.self_forcing else num_steps


def _all_views(batch: joint_dataset.WindowBatch) -> UInt8[Tensor, "n time px px 3"]:
    """Images of the head, then of the further views that are not missing."""
    if batch.further is None:
        return batch.images
    missing = [[one is None for one in request.further_images] for request in batch.requests]
    return torch.cat([batch.images, batch.further[~torch.tensor(missing)]])


@dataclass(frozen=True)
class TrainingReport:
    """Result of a run, with its accuracy on held-out episodes."""

    checkpoint: Path
    digest: str
    num_parameters: int
    steps: int
    cpu_s: float
    wall_s: float
    num_train_episodes: int
    num_heldout_episodes: int
    metrics: dict[str, float]
    log: list[TrainingProgress] = field(default_factory=list)


def train(
    settings: TrainSettings, on_progress: OnProgress | None = None, processes: Processes = ALONE
) -> TrainingReport | None:
    """Load episodes, train, write and evaluate the checkpoint; None but in the first process.

    Raises:
        InvalidInputError: no episodes, too short ones, or held-out ones among those trained on.
    """
    trained, heldout = episode_sets.load_split(settings)
    return train_on(trained, heldout, settings, on_progress, processes)


def train_on(
    trained: Sequence[joint_dataset.TrainingEpisode],
    heldout: Sequence[joint_dataset.EpisodeArrays],
    settings: TrainSettings,
    on_progress: OnProgress | None = None,
    processes: Processes = ALONE,
) -> TrainingReport | None:
    """`train` with episodes that are already split."""
    episode_sets.check_disjoint(trained, heldout)
    # Before training, so that too short ones are found at once.
    evaluated_places(heldout, settings.network.max_steps, settings.evaluation_stride)
    settings, tokenizer = with_tokenizer(settings)
    settings, layouts = settings.with_adapters(), [e.tactile_layout for e in (*trained, *heldout)]
    layout = common_layout(layouts, what="training episodes")
    if tokenizer is not None:
        known = settings.network.tactile_layout
        common_layout([known, layout], what="--tokenizer and the training episodes")
        check_unseen(heldout, tokenizer)
    network = _at_rate(settings, trained[0].model_rate_hz).with_layout(layout)
    settings = settings.model_copy(update={"network": network})
    torch.set_num_threads(settings.num_threads)
    ancestor = None if settings.init is None else checkpoints.read_checkpoint(settings.init)
    known_tasks: set[str] = set()
    if ancestor is not None:
        known_tasks = {*ancestor.metadata.tasks, *checkpoints.learned_tasks(ancestor.metadata.sets)}
    episode_sets.check_tasks((*trained, *heldout), settings, known_tasks)
    if ancestor is not None:
        # Episodes that the initial checkpoint was trained on cannot be held out either.
        refuse_trained(heldout, ancestor.metadata.train_fingerprints, "the initial checkpoint")
    run = TrainingRun(trained, settings, processes)
    log = _run_or_resume(run, ancestor, tokenizer, on_progress)
    averaged = run.whole_average()
    files, budget = resume_files.StateFiles(settings.output, processes), run.budget
    # Its gradients and moments need not be there while the checkpoint is evaluated.
    del run
    if averaged is None:
        return None
    metadata = _metadata(settings, averaged.config, budget, trained, heldout, ancestor)
    if tokenizer is not None:
        metadata = metadata.model_copy(update={"tokenizer_digest": tokenizer.digest})
    checkpoints.write_checkpoint(settings.output, averaged, metadata)
    del averaged
    # Evaluate the weights as stored, then store them again with the results.
    stored = on_device(checkpoints.read_checkpoint(settings.output).model, settings.device)
    metrics = evaluate_prediction(
        stored,
        heldout,
        train_fingerprints=metadata.train_fingerprints,
        stride=settings.evaluation_stride,
    )
    digest = checkpoints.write_checkpoint(
        settings.output, stored, metadata.model_copy(update={"metrics": metrics})
    )
    if not is_cut_short(settings, budget):
        files.remove()
    return TrainingReport(
        checkpoint=settings.output,
        digest=digest,
        num_parameters=sum(p.numel() for p in stored.parameters()),
        steps=budget.step,
        cpu_s=budget.cpu_s,
        wall_s=budget.wall_s,
        num_train_episodes=len(trained),
        num_heldout_episodes=len(heldout),
        metrics=metrics,
        log=log,
    )


def _at_rate(settings: TrainSettings, rate_hz: float) -> NetworkConfig:
    """The configuration at the rate of the episodes; ConflictError if another one is requested."""
    network = settings.network
    if "model_rate_hz" in network.model_fields_set and network.model_rate_hz != rate_hz:
        has, advice = "--network.model-rate-hz is", "leave it out, or align them at that rate"
        if settings.init is not None:
            has, advice = f"{settings.init} has steps at", "align them at its rate"
        raise ConflictError(
            f"training: {has} {network.model_rate_hz:g} Hz, the episodes have steps at "
            f"{rate_hz:g} Hz; {advice}"
        )
    return network.model_copy(update={"model_rate_hz": rate_hz})


def _metadata(
    settings: TrainSettings,
    network: NetworkConfig,
    budget: optimizer.Budget,
    trained: Sequence[joint_dataset.TrainingEpisode],
    heldout: Sequence[joint_dataset.EpisodeArrays],
    ancestor: checkpoints.Checkpoint | None,
) -> checkpoints.CheckpointMetadata:
    """Provenance of a trained model, with that of the checkpoint that it was started from."""
    before = None if ancestor is None else ancestor.metadata
    prints = {episode.fingerprint() for episode in trained}
    names = {episode.episode_id for episode in trained}
    windows = settings.windows
    dropped = checkpoints.dropout_shares(windows.text_dropout, windows.action_dropout, ancestor)
    of_views = windows.view_dropout or (before.view_dropout if before else 0.0)
    return checkpoints.CheckpointMetadata(
        name=settings.name,
        network=network,
        tasks=tuple(sorted({episode.task for episode in trained})),
        command=command_line(settings),
        seed=settings.seed,
        training_steps=budget.step,
        training_cpu_s=round(budget.cpu_s, 1),
        train_episode_ids=tuple(sorted(names.union(before.train_episode_ids if before else ()))),
        train_fingerprints=tuple(sorted(prints.union(before.train_fingerprints if before else ()))),
        data_hash=_data_hash(trained, settings, ancestor),
        horizon_latents=max(
            num_latents(max(map(len, trained))) - 1, before.horizon_latents if before else 0
        ),
        heldout_episode_ids=tuple(sorted(episode.episode_id for episode in heldout)),
        initialized_from=None if ancestor is None else ancestor.digest,
        sets=episode_sets.training_sets(
            trained,
            heldout,
            human_share=settings.share_of_human,
            image_px=settings.network.image_px,
            inherited=before.sets if before else (),
            ancestor=None if ancestor is None else ancestor.digest,
        ),
        tokenizer_digest=before.tokenizer_digest if before else None,
        text_dropout=dropped[0],
        action_dropout=dropped[1],
        view_dropout=of_views if network.further_views else 0.0,
    )


def _data_hash(
    episodes: Sequence[joint_dataset.TrainingEpisode],
    settings: TrainSettings,
    ancestor: checkpoints.Checkpoint | None,
) -> str:
    """Hash of the episodes, and of those that the initial checkpoint was trained on."""
    return data_hash(
        (episode.content_sha256 for episode in episodes),
        image_px=settings.network.image_px,
        ancestor=None if ancestor is None else ancestor.metadata.data_hash,
    )


def _run_or_resume(
    run: "TrainingRun",
    ancestor: checkpoints.Checkpoint | None,
    tokenizer: checkpoints.StoredTokenizer | None,
    on_progress: OnProgress | None,
) -> list[TrainingProgress]:
    """Run from the start or resume an interrupted run; saves its state regularly."""
    settings = run.settings
    files = resume_files.StateFiles(settings.output, run.processes)
    identity = resume_files.identity_of(
        settings,
        data_hash=_data_hash(run.episodes, settings, None),
        init_digest=None if ancestor is None else ancestor.digest,
        tokenizer_digest=None if tokenizer is None else tokenizer.digest,
    )
    if ancestor is not None:
        run.start_from(ancestor)
    if settings.resume and files.exists():
        like = {**resume_files.moments_like(run.learned), **run.state(identity).tensors}
        run.restore(files.read(identity, like))
        if run.budget.share() >= 1.0 and is_cut_short(settings, run.budget):
            raise ConflictError(
                f"training: cut short at step {run.budget.step} of {settings.step_limit} after "
                f"{run.budget.wall_s:.0f} s ({run.budget.cpu_s:.0f} CPU s), and limits count in "
                "all; resume with a larger --wall-budget-s or --cpu-budget-s"
            )
    elif ancestor is None:
        run.fit_codecs(None if tokenizer is None else tokenizer.tokenizer)
    # Images that the model itself drew come once only.
    use_latent_cache(run.model, settings.wan, adds=not settings.self_forcing)
    kept_s = run.budget.wall_s

    def keep(now: TrainingRun) -> None:
        nonlocal kept_s
        is_last = now.budget.share() >= 1.0 and is_cut_short(settings, now.budget)
        if is_last or now.budget.wall_s - kept_s >= settings.state_every_s:
            began_s = time.monotonic()
            files.write(now.state(identity))
            spent = torch.tensor(time.monotonic() - began_s, dtype=torch.float64)
            # The same in all processes, which must decide alike.
            kept_s = now.budget.wall_s + run.processes.mean(spent).item()

    return run.run(on_progress, keep)


def is_cut_short(settings: TrainSettings, budget: optimizer.Budget) -> bool:
    """Whether time ended a run before its last step, so that `--resume` can go on."""
    return settings.step_limit is not None and budget.step < settings.step_limit
