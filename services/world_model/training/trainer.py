"""Training of the joint flow-matching model, from settings to an evaluated checkpoint."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from dextouch.episodes import data_hash
from services.networks.memory import on_device
from services.world_model.checkpoints import (
    Checkpoint,
    CheckpointMetadata,
    read_checkpoint,
    write_checkpoint,
)
from services.world_model.recorded_commands import command_line
from services.world_model.settings import TrainSettings
from services.world_model.tokenizer_files import StoredTokenizer
from services.world_model.training.dataset import (
    EpisodeArrays,
    TrainingEpisode,
)
from services.world_model.training.distribution import (
    ALONE,
    Processes,
)
from services.world_model.training.domains import check_tasks, training_sets
from services.world_model.training.evaluation import evaluate_prediction
from services.world_model.training.frozen_tokenizer import check_unseen, with_tokenizer
from services.world_model.training.splits import (
    check_disjoint,
    check_not_learned,
    load_split,
)
from services.world_model.training.state_files import StateFiles
from services.world_model.training.training_run import OnProgress, TrainingProgress, TrainingRun
from services.world_model.training.training_state import (
    RunFacts,
    TrainingState,
    identity_of,
)
from services.world_model.training_set import learned_tasks


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
    settings: TrainSettings,
    on_progress: OnProgress | None = None,
    processes: Processes = ALONE,
) -> TrainingReport | None:
    """Load episodes, train, write and evaluate the checkpoint.

    Only the first of several processes writes, evaluates and reports; the others return None.

    Raises:
        InvalidInputError: no episodes, too short ones, or held-out ones among those trained on.
    """
    trained, heldout = load_split(settings)
    return train_on(trained, heldout, settings, on_progress, processes)


def train_on(
    trained: Sequence[TrainingEpisode],
    heldout: Sequence[EpisodeArrays],
    settings: TrainSettings,
    on_progress: OnProgress | None = None,
    processes: Processes = ALONE,
) -> TrainingReport | None:
    """`train` with episodes that are already split."""
    check_disjoint(trained, heldout)
    settings, tokenizer = with_tokenizer(settings)
    if tokenizer is not None:
        check_unseen(heldout, tokenizer)
    torch.set_num_threads(settings.num_threads)
    ancestor = None if settings.init is None else read_checkpoint(settings.init)
    check_tasks((*trained, *heldout), settings, _known_tasks(ancestor))
    prints = {episode.fingerprint() for episode in trained}
    names = {episode.episode_id for episode in trained}
    if ancestor is not None:
        # Episodes that the initial checkpoint was trained on cannot be held out either.
        check_not_learned(heldout, ancestor)
        prints |= set(ancestor.metadata.train_fingerprints)
        names |= set(ancestor.metadata.train_episode_ids)
    run = TrainingRun(trained, settings, processes)
    log = _run_or_resume(run, ancestor, tokenizer, on_progress)
    averaged = run.whole_average()
    if averaged is None:
        return None
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
        data_hash=_data_hash(trained, settings, ancestor),
        heldout_episode_ids=tuple(sorted(episode.episode_id for episode in heldout)),
        initialized_from=None if ancestor is None else ancestor.digest,
        sets=training_sets(
            trained,
            heldout,
            human_share=settings.share_of_human,
            image_px=settings.network.image_px,
            inherited=() if ancestor is None else ancestor.metadata.sets,
            ancestor=None if ancestor is None else ancestor.digest,
        ),
        tokenizer_digest=_tokenizer_digest(ancestor, tokenizer),
    )
    write_checkpoint(settings.output, averaged, metadata)
    # Evaluate the weights as stored, then store them again with the results.
    stored = on_device(read_checkpoint(settings.output).model, settings.device)
    metrics = {
        **evaluate_prediction(
            stored, heldout, train_fingerprints=sorted(prints), stride=settings.evaluation_stride
        )
    }
    digest = write_checkpoint(
        settings.output, stored, metadata.model_copy(update={"metrics": metrics})
    )
    StateFiles(settings.output, processes).remove()
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


def _known_tasks(ancestor: Checkpoint | None) -> set[str]:
    """Tasks that a checkpoint and its ancestors were trained on."""
    if ancestor is None:
        return set()
    return {*ancestor.metadata.tasks, *learned_tasks(ancestor.metadata.sets)}


def _data_hash(
    episodes: Sequence[TrainingEpisode], settings: TrainSettings, ancestor: Checkpoint | None
) -> str:
    """Hash of the episodes, and of those that the initial checkpoint was trained on."""
    return data_hash(
        (episode.content_sha256 for episode in episodes),
        image_px=settings.network.image_px,
        ancestor=None if ancestor is None else ancestor.metadata.data_hash,
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
    files = StateFiles(settings.output, run.processes)
    identity = identity_of(
        settings,
        data_hash=_data_hash(run.episodes, settings, None),
        init_digest=None if ancestor is None else ancestor.digest,
        tokenizer_digest=None if tokenizer is None else tokenizer.digest,
    )
    if settings.resume and files.exists():
        run.restore(files.read(identity, run.like_state()))
    elif ancestor is not None:
        run.start_from(ancestor)
    else:
        run.fit_codecs(None if tokenizer is None else tokenizer.tokenizer)
    kept_cpu_s = run.budget.cpu_s

    def keep(now: TrainingRun) -> None:
        nonlocal kept_cpu_s
        if now.budget.cpu_s - kept_cpu_s >= settings.state_every_cpu_s:
            tensors, facts = now.state()
            files.write(TrainingState(tensors, RunFacts(identity=identity, **facts)))
            kept_cpu_s = now.budget.cpu_s

    return run.run(on_progress, keep)
