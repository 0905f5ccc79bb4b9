"""Training of the joint flow-matching model, from settings to an evaluated checkpoint."""

import copy
import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from pydantic import JsonValue

from dextouch.episodes import data_hash, split_by_scene
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.schemas import Domain
from dextouch.tactile.layout import common_layout
from services.networks import optimizer
from services.networks.weight_files import on_device
from services.world_model import checkpoints
from services.world_model.network.configuration import WanFiles, num_latents
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.network.tactile import TactileTokenizer
from services.world_model.paper_settings import TrainSettings, command_line
from services.world_model.pretrained_video import initial_model, share_texts
from services.world_model.training import dataset, tokenizer_trainer, training_state
from services.world_model.training.distribution import ALONE, Processes, load_whole, whole_weights
from services.world_model.training.evaluation import evaluate_prediction, refuse_trained
from services.world_model.training.objective import LossOptions, losses, own_context

LOG_EVERY_STEPS = 20


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
        episodes: Sequence[dataset.TrainingEpisode],
        settings: TrainSettings,
        processes: Processes = ALONE,
    ) -> None:
        processes.check(settings.optimizer.batch, settings.device)
        self.settings = settings
        self.episodes = episodes
        self.processes = processes
        self.budget = optimizer.Budget(settings.cpu_budget_s, settings.max_steps)
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
        self._sampler = dataset.WindowSampler(
            episodes,
            self._rng,
            max_steps=self._window_steps(settings.network.max_steps),
            human_share=settings.share_of_human,
        )
        options = settings.optimizer.options()
        self.loop = optimizer.OptimizerLoop(self.model, options, self.budget)

    @torch.no_grad()
    def fit_codecs(self, tokenizer: TactileTokenizer | None = None) -> None:
        """Fit everything in closed form: codecs, action statistics, residual scales.

        A pretrained tokenizer is taken instead of fitting one.
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

    def start_from(self, checkpoint: checkpoints.Checkpoint) -> None:
        """Take over the weights and codecs of a checkpoint.

        Raises:
            ConflictError: the checkpoint has other network settings; they are named.
        """
        common_layout(
            [checkpoint.metadata.network.tactile_layout, self.settings.network.tactile_layout],
            what="--init and the training episodes",
        )
        sampling = {"sampling_steps", "sampler", "sampling_time_shift", "layout"}
        requested = self.settings.network.model_dump(exclude=sampling)
        there = checkpoint.metadata.network.model_dump(exclude=sampling)
        others = {n: (there[n], value) for n, value in requested.items() if there[n] != value}
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

    def state(self, identity: dict[str, JsonValue]) -> training_state.TrainingState:
        """Tensors and metadata that the next steps depend on."""
        tensors = {f"model.{n}": t for n, t in self.model.state_dict().items()}
        tensors |= {f"averaged.{n}": t for n, t in self.averaged.state_dict().items()}
        tensors |= training_state.optimizer_tensors(self.loop.optimizer)
        tensors["generator"] = self._generator.get_state()
        facts = training_state.RunFacts(
            identity=identity,
            step=self.budget.step,
            cpu_s=self.budget.cpu_s,
            window_numbers=self._window_numbers,
            log=tuple(astuple(entry) for entry in self.log),
        )
        return training_state.TrainingState(tensors, facts)

    def restore(self, state: training_state.TrainingState) -> None:
        """Continue from `state`."""
        self.model.load_state_dict(training_state.part_of(state.tensors, "model."))
        self.averaged.load_state_dict(training_state.part_of(state.tensors, "averaged."))
        training_state.restore_optimizer(self.loop.optimizer, state.tensors)
        self._generator.set_state(state.tensors["generator"])
        self._window_numbers = state.facts.window_numbers
        self._rng.bit_generator.state = json.loads(self._window_numbers)
        self.budget.step, self.budget.cpu_s = state.facts.step, state.facts.cpu_s
        self.log = [TrainingProgress(*row) for row in state.facts.log]

    def run(
        self, on_progress: OnProgress | None = None, on_step: OnState | None = None
    ) -> list[TrainingProgress]:
        """Train until the budget or the number of steps is used up; returns the loss log.

        `on_progress` is called with every entry of the log, `on_step` with the run after every
        step.
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
                share = min(budget.share(), 1.0)
                progress = TrainingProgress(budget.step, share, loss_video, loss_tactile)
                self.log.append(progress)
                if on_progress is not None:
                    on_progress(progress)
            if on_step is not None:
                on_step(self)
        return self.log

    def learn(self, batch: dataset.WindowBatch) -> tuple[float, float]:
        """One optimizer step; returns the video and tactile losses."""
        settings = self.settings.optimizer
        if self.settings.self_forcing:
            batch = own_context(
                self.model, batch, generator=self._generator, processes=self.processes
            )
        windows = self.settings.windows
        options = LossOptions(
            windows.context_noise,
            settings.touch_loss,
            settings.precision,
            own_noisy=self.settings.self_forcing,
            text_dropout=windows.text_dropout,
            action_dropout=windows.action_dropout,
        )
        loss = losses(
            self.model,
            batch,
            generator=self._generator,
            options=options,
            processes=self.processes,
        )
        total = loss.video + settings.tactile_weight * loss.tactile
        self.loop.learn(total, video=loss.video, touch=loss.tactile)
        optimizer.update_average(
            self.averaged, self.model, decay=settings.ema_decay, num_updates=self.budget.step
        )
        video, tactile = self.processes.mean(torch.stack([loss.video, loss.tactile])).tolist()
        return video, tactile

    def _batches(self) -> Iterator[dataset.WindowBatch]:
        if self.settings.streaming:
            workers = self.settings.loader_workers
            return dataset.read_batches(self.episodes, self._noted_places(), num_workers=workers)
        return map(self._sampler.cut, self._noted_places())

    def _noted_places(self) -> Iterator[list[dataset.WindowPosition]]:
        """`places`, recording the generator state after each, since readers fetch ahead."""
        for places in self.places():
            self._drawn.append(json.dumps(self._rng.bit_generator.state))
            yield self.processes.own(places)

    def places(self) -> Iterator[list[dataset.WindowPosition]]:
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


def train(
    settings: TrainSettings, on_progress: OnProgress | None = None, processes: Processes = ALONE
) -> TrainingReport | None:
    """Load episodes, train, write and evaluate the checkpoint.

    Only the first of several processes writes, evaluates and reports; the others return None.

    Raises:
        InvalidInputError: no episodes, too short ones, or held-out ones among those trained on.
    """
    trained, heldout = load_split(settings)
    return train_on(trained, heldout, settings, on_progress, processes)


def train_on(
    trained: Sequence[dataset.TrainingEpisode],
    heldout: Sequence[dataset.EpisodeArrays],
    settings: TrainSettings,
    on_progress: OnProgress | None = None,
    processes: Processes = ALONE,
) -> TrainingReport | None:
    """`train` with episodes that are already split."""
    check_disjoint(trained, heldout)
    settings, tokenizer = tokenizer_trainer.with_tokenizer(settings)
    settings = _with_layout(settings, (*trained, *heldout), tokenizer)
    if tokenizer is not None:
        tokenizer_trainer.check_unseen(heldout, tokenizer)
    torch.set_num_threads(settings.num_threads)
    ancestor = None if settings.init is None else checkpoints.read_checkpoint(settings.init)
    known_tasks: set[str] = set()
    if ancestor is not None:
        known_tasks = {*ancestor.metadata.tasks, *checkpoints.learned_tasks(ancestor.metadata.sets)}
    dataset.check_tasks((*trained, *heldout), settings, known_tasks)
    prints = {episode.fingerprint() for episode in trained}
    names = {episode.episode_id for episode in trained}
    if ancestor is not None:
        # Episodes that the initial checkpoint was trained on cannot be held out either.
        refuse_trained(heldout, ancestor.metadata.train_fingerprints, "the initial checkpoint")
        prints |= set(ancestor.metadata.train_fingerprints)
        names |= set(ancestor.metadata.train_episode_ids)
    run = TrainingRun(trained, settings, processes)
    log = _run_or_resume(run, ancestor, tokenizer, on_progress)
    averaged = run.whole_average()
    if averaged is None:
        return None
    metadata = checkpoints.CheckpointMetadata(
        name=settings.name,
        network=settings.network,
        tasks=tuple(sorted({episode.task for episode in trained})),
        command=command_line(settings),
        seed=settings.seed,
        training_steps=run.budget.step,
        training_cpu_s=round(run.budget.cpu_s, 1),
        train_episode_ids=tuple(sorted(names)),
        train_fingerprints=tuple(sorted(prints)),
        data_hash=_data_hash(trained, settings, ancestor),
        horizon_latents=max(
            num_latents(max(map(len, trained))) - 1,
            0 if ancestor is None else ancestor.metadata.horizon_latents,
        ),
        heldout_episode_ids=tuple(sorted(episode.episode_id for episode in heldout)),
        initialized_from=None if ancestor is None else ancestor.digest,
        sets=dataset.training_sets(
            trained,
            heldout,
            human_share=settings.share_of_human,
            image_px=settings.network.image_px,
            inherited=() if ancestor is None else ancestor.metadata.sets,
            ancestor=None if ancestor is None else ancestor.digest,
        ),
        tokenizer_digest=_tokenizer_digest(ancestor, tokenizer),
    )
    checkpoints.write_checkpoint(settings.output, averaged, metadata)
    # Evaluate the weights as stored, then store them again with the results.
    stored = on_device(checkpoints.read_checkpoint(settings.output).model, settings.device)
    metrics = evaluate_prediction(
        stored, heldout, train_fingerprints=sorted(prints), stride=settings.evaluation_stride
    )
    digest = checkpoints.write_checkpoint(
        settings.output, stored, metadata.model_copy(update={"metrics": metrics})
    )
    training_state.StateFiles(settings.output, processes).remove()
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


def _with_layout(
    settings: TrainSettings,
    episodes: Sequence[dataset.TrainingEpisode],
    tokenizer: checkpoints.StoredTokenizer | None,
) -> TrainSettings:
    """The settings with a network for the taxels of all episodes.

    Raises:
        InvalidInputError: episodes of several gloves, or a tokenizer of another one.
    """
    layout = common_layout([one.tactile_layout for one in episodes], what="training episodes")
    if tokenizer is not None:
        known = settings.network.tactile_layout
        common_layout([known, layout], what="--tokenizer and the training episodes")
    network = settings.network.with_layout(layout)
    return settings.model_copy(update={"network": network})


def _data_hash(
    episodes: Sequence[dataset.TrainingEpisode],
    settings: TrainSettings,
    ancestor: checkpoints.Checkpoint | None,
) -> str:
    """Hash of the episodes, and of those that the initial checkpoint was trained on."""
    return data_hash(
        (episode.content_sha256 for episode in episodes),
        image_px=settings.network.image_px,
        ancestor=None if ancestor is None else ancestor.metadata.data_hash,
    )


def _tokenizer_digest(
    ancestor: checkpoints.Checkpoint | None, tokenizer: checkpoints.StoredTokenizer | None
) -> str | None:
    if tokenizer is not None:
        return tokenizer.digest
    return None if ancestor is None else ancestor.metadata.tokenizer_digest


def _run_or_resume(
    run: "TrainingRun",
    ancestor: checkpoints.Checkpoint | None,
    tokenizer: checkpoints.StoredTokenizer | None,
    on_progress: OnProgress | None,
) -> list[TrainingProgress]:
    """Run from the start or resume an interrupted run; saves its state regularly."""
    settings = run.settings
    files = training_state.StateFiles(settings.output, run.processes)
    identity = training_state.identity_of(
        settings,
        data_hash=_data_hash(run.episodes, settings, None),
        init_digest=None if ancestor is None else ancestor.digest,
        tokenizer_digest=None if tokenizer is None else tokenizer.digest,
    )
    if settings.resume and files.exists():
        like = {**training_state.moments_like(run.loop.optimizer), **run.state(identity).tensors}
        run.restore(files.read(identity, like))
    elif ancestor is not None:
        run.start_from(ancestor)
    else:
        run.fit_codecs(None if tokenizer is None else tokenizer.tokenizer)
    kept_cpu_s = run.budget.cpu_s

    def keep(now: TrainingRun) -> None:
        nonlocal kept_cpu_s
        if now.budget.cpu_s - kept_cpu_s >= settings.state_every_cpu_s:
            files.write(now.state(identity))
            kept_cpu_s = now.budget.cpu_s

    return run.run(on_progress, keep)


def load_split(
    settings: TrainSettings,
) -> tuple[Sequence[dataset.TrainingEpisode], list[dataset.EpisodeArrays]]:
    """Training and held-out episodes of the settings' stores; held-out ones are in memory.

    Robot episodes are split before a subset of them is taken, so that every subset has the same
    held-out episodes. These are never human if human stores are given.
    """
    px = settings.network.image_px
    how = dataset.index_episodes if settings.streaming else dataset.load_episodes
    read = partial(how, splits=settings.splits, image_px=px)
    domain: Domain | None = "robot" if settings.human else None
    trained: Sequence[dataset.TrainingEpisode] = read(settings.episodes, domain=domain)
    if settings.heldout is not None:
        heldout = dataset.load_episodes(settings.heldout, domain=domain, image_px=px)
    else:
        trained, stored = _split(trained, settings)
        heldout = [one.load() if isinstance(one, dataset.StoredEpisode) else one for one in stored]
    trained = dataset.subset_by_hash(trained, settings.robot_episodes, what="robot")
    people: list[dataset.TrainingEpisode] = []
    for url in settings.human if settings.human_episodes != 0 else ():
        people += read(url, domain="human")
    together = [*trained, *dataset.subset_by_hash(people, settings.human_episodes, what="human")]
    rates_hz = {episode.model_rate_hz for episode in (*together, *heldout)}
    ids = [episode.episode_id for episode in together]
    dataset.check_stores([settings.episodes, *settings.human], ids, rates_hz)
    return together, heldout


def _split(
    episodes: Sequence[dataset.E], settings: TrainSettings
) -> tuple[list[dataset.E], list[dataset.E]]:
    if settings.tokenizer is None:
        return split_by_scene(episodes, held_out_share=settings.heldout_percent / 100)
    stored = checkpoints.read_tokenizer(settings.tokenizer)
    return tokenizer_trainer.split_unseen(
        episodes, stored, heldout_percent=settings.heldout_percent
    )


def check_disjoint(
    trained: Sequence[dataset.TrainingEpisode], heldout: Sequence[dataset.TrainingEpisode]
) -> None:
    """Raise if a held-out episode, or its scene, is also trained on."""
    prints = {episode.fingerprint() for episode in trained}
    scenes = {episode.scene for episode in trained}
    both = [
        episode.episode_id
        for episode in heldout
        if episode.fingerprint() in prints or episode.scene in scenes
    ]
    if both:
        raise InvalidInputError(
            f"training: {len(both)} held-out episodes are also trained on {both[:3]} (same content "
            "or same scene); expected disjoint sets",
            episodes=both,
        )
