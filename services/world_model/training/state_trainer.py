"""Training of a state model: trains, evaluates and writes an ensemble from episode stores.

Members are trained in separate processes and stored when they are finished, so that an interrupted
run resumes with the missing ones.
"""

import hashlib
import multiprocessing
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from dextouch.command_line import ProgressLines
from dextouch.episodes import (
    SPLITS,
    EpisodeGrid,
    Split,
    data_hash,
    scene_fraction,
    split_by_scene,
)
from dextouch.errors import InvalidInputError
from dextouch.schemas import load_object_clicks
from services.networks.training_settings import USUAL_IMAGE_PX
from services.networks.weight_files import read_tensors, write_tensors
from services.world_model.dynamics.configuration import DynamicsConfig
from services.world_model.dynamics.core import RecurrentCore
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.dynamics.start_reader import Reading, StartReader
from services.world_model.dynamics.touch_codec import TouchCodec
from services.world_model.recorded_commands import flags_of, last_name
from services.world_model.rendering.network import RendererNetwork
from services.world_model.rendering.precision import uses_bfloat16
from services.world_model.rendering.training import RendererProgress, train_renderer
from services.world_model.settings import StateTrainSettings
from services.world_model.state_checkpoints import (
    StateBounds,
    StateMetadata,
    scene_digest,
    write_state_checkpoint,
)
from services.world_model.training.averaging import OnStep
from services.world_model.training.core_training import (
    CoreData,
    start_steps,
    touch_latents,
    train_core,
)
from services.world_model.training.reader_training import read_step, train_reader
from services.world_model.training.scene_clips import scene_clips
from services.world_model.training.scene_episodes import SceneGrid, load_scene_episodes
from services.world_model.training.scene_table import (
    SceneTable,
    scene_table,
    usual_boxes_m,
    vocabulary,
)
from services.world_model.training.state_evaluation import evaluate_dynamics
from services.world_model.training.transfer import Base

# Increment when a change of training gives other weights for the same settings and data.
READER_VERSION, CORE_VERSION, RENDERER_VERSION = 6, 9, 3
# Largest number of episodes the renderer is trained on; it samples few of their images anyway.
MAX_CLIPS = 1500
_SEED_STRIDE = 1000
_CPU_S = "cpu_s"


@dataclass(frozen=True)
class StateReport:
    """Result of a run, with its accuracy on held-out scenes."""

    checkpoint: Path
    digest: str
    num_parameters: int
    cpu_s: float
    num_training_episodes: int
    num_heldout_episodes: int
    metrics: dict[str, float]


def train_state(settings: StateTrainSettings) -> StateReport:
    """Train every member, evaluate the ensemble and write it.

    Raises:
        InvalidInputError: no episodes, or episodes that do not fit together.
    """
    torch.set_num_threads(1)
    if settings.base is None and settings.keep_readers:
        raise InvalidInputError("train state: got --keep-readers without --base; add --base PATH")
    settings = _with_precision(settings)
    command = _command(settings)
    episodes = _episodes(settings)
    training, heldout = split_by_scene(episodes, held_out_share=settings.heldout_share)
    config = _config(episodes, settings)
    base = None if settings.base is None else Base(settings.base)
    if base is not None:
        config = base.configured(config)
        settings = _with_base(base, config, settings)
    parts = settings.output.with_suffix(".parts")
    parts.mkdir(parents=True, exist_ok=True)
    hashed = data_hash(
        (episode.content_sha256 for episode in training),
        image_px=None if settings.image_px == USUAL_IMAGE_PX else settings.image_px,
    )
    # Before training, so that invalid episodes are found at once.
    heldout_table = scene_table(heldout, config)
    table = scene_table(training, config, labelled=_labelled(training, settings))
    if base is None:
        _check_drawable(training)
    codec = _codec(table, config, base)
    reads_starts = settings.labelled_share < 1 or not all(
        bool(table.knows_all(step).all()) for step in start_steps(table)
    )
    table_file = parts / "table.safetensors"
    save_file({**table.tensors(), **_prefixed(codec)}, table_file)
    del table
    work = _Work(settings, config, parts, hashed, reads_starts)
    _train_parts(work)
    dynamics, renderer, cpu_s = _assembled(work, codec)
    measured = evaluate_dynamics(dynamics, heldout_table)
    metadata = StateMetadata(
        name=settings.name,
        dynamics=config,
        num_members=settings.num_members,
        renderer=settings.renderer,
        object_names={e.task: e.object_names for e in episodes},
        object_boxes_m={
            task: tuple(tuple(map(float, row)) for row in boxes_m)
            for task, boxes_m in usual_boxes_m(episodes).items()
        },
        bounds=StateBounds(
            disagreement_m=measured.disagreement_m,
            distance=measured.distance,
            horizon_latents=measured.num_latents,
            of_chunks=True,
        )
        if base is None
        else base.checkpoint.metadata.bounds,
        command=command,
        seed=settings.seed,
        training_cpu_s=round(cpu_s, 1),
        num_training_episodes=len(training),
        training_seeds=_seed_ranges(training, base),
        training_splits=_splits(settings, base),
        training_scenes=_recorded_scenes(training, base),
        data_hash=hashed,
        object_sources=_sources(training),
        metrics=measured.figures,
    )
    digest = write_state_checkpoint(settings.output, dynamics, renderer, metadata)
    table_file.unlink()
    return StateReport(
        settings.output,
        digest,
        sum(p.numel() for p in (*dynamics.parameters(), *renderer.parameters())),
        cpu_s,
        len(training),
        len(heldout),
        measured.figures,
    )


@dataclass(frozen=True)
class _Work:
    """Input of every member's process."""

    settings: StateTrainSettings
    config: DynamicsConfig
    parts: Path
    data_hash: str
    # Whether some episodes start from what a reader sees, since their objects are not known there.
    reads_starts: bool

    @cached_property
    def base(self) -> Base | None:
        """The model that this one starts from, if any."""
        return None if self.settings.base is None else Base(self.settings.base)

    def reader_file(self, member: int) -> Path:
        """File of a member's finished reader; its name depends on settings and data."""
        return self.parts / f"reader-{self._key(READER_VERSION, 'reader')}-{member}.safetensors"

    def core_file(self, member: int) -> Path:
        """File of a member's finished core, which was trained with that member's reader."""
        reader = ("reader",) if self.reads_starts else ()
        key = self._key(CORE_VERSION, "width", *reader, "core")
        return self.parts / f"core-{key}-{member}.safetensors"

    @property
    def renderer_file(self) -> Path:
        """File of the finished renderer."""
        key = self._key(RENDERER_VERSION, "renderer", "drawing")
        return self.parts / f"renderer-{key}.safetensors"

    def _key(self, version: int, *names: str) -> str:
        """Digest of the data and of the settings that affect the weights."""
        chosen = self.settings.model_dump_json(
            include={"seed", "heldout_share", "labelled_share", *names}
        )
        base = "" if self.base is None else self.base.checkpoint.digest
        text = f"{version} {chosen} {self.data_hash} {base}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _with_base(
    base: Base, config: DynamicsConfig, settings: StateTrainSettings
) -> StateTrainSettings:
    """Settings of a run that keeps the base's networks and trains no more of cores than success."""
    if settings.keep_readers and not base.has_tasks_of(config):
        raise InvalidInputError(
            f"--keep-readers: the episodes have tasks {', '.join(config.tasks)}, expected the "
            f"base's, {', '.join(base.checkpoint.metadata.dynamics.tasks)}; leave it out to train "
            "start readers for other tasks"
        )
    about = base.checkpoint.metadata
    nothing_else = dict.fromkeys(("objects", "touch", "contact", "taxels"), 0.0)
    only_success = settings.core.weights.model_copy(update=nothing_else)
    kept = {
        "num_members": about.num_members,
        "renderer": about.renderer,
        "core": settings.core.model_copy(update={"weights": only_success}),
    }
    return settings.model_copy(update=kept)


def _with_precision(settings: StateTrainSettings) -> StateTrainSettings:
    """Settings that name the precision: it is chosen once, and part of the readers' keys."""
    chosen = {"bfloat16": uses_bfloat16(setting=settings.reader.bfloat16)}
    return settings.model_copy(update={"reader": settings.reader.model_copy(update=chosen)})


def _episodes(settings: StateTrainSettings) -> list[SceneGrid]:
    return load_scene_episodes(
        *settings.episodes,
        tasks=settings.tasks,
        splits=settings.splits,
        image_px=settings.image_px,
        clicks=None if settings.clicks is None else load_object_clicks(settings.clicks),
    )


def _config(episodes: Sequence[EpisodeGrid], settings: StateTrainSettings) -> DynamicsConfig:
    tasks, num_objects = vocabulary(episodes)
    sides = {episode.image_size_px[0] for episode in episodes}
    if len(sides) != 1:
        raise InvalidInputError(
            f"state model: got episodes with images of {sorted(sides)} px, expected one size"
        )
    return DynamicsConfig(
        tasks=tasks, num_objects=num_objects, image_px=sides.pop(), width=settings.width
    )


def _check_drawable(episodes: Sequence[EpisodeGrid]) -> None:
    """Refuse what no renderer can be trained on, before hours of training other parts."""
    for one in episodes:
        if one.objects is not None and one.objects.known[one.image_steps].all(axis=1).sum() > 1:
            return
    raise InvalidInputError(
        "state model: no episode shows all of its objects at known poses twice, which cores and "
        "the renderer learn from (clicks are poses of the first step alone); add --base PATH, a "
        "trained state model whose cores and renderer are kept"
    )


def _has_poses(episode: EpisodeGrid) -> bool:
    """Whether the pose of some object is known; true of tasks without objects."""
    track = episode.objects
    return not episode.object_names or (track is not None and bool(track.known.any()))


def _labelled(episodes: Sequence[EpisodeGrid], settings: StateTrainSettings) -> list[bool]:
    """Mask of episodes whose object poses are trained on.

    Of a scene, these are all takes that have poses, or none.
    """
    # Training scenes lie above the held-out share.
    share = settings.heldout_share + (1 - settings.heldout_share) * settings.labelled_share
    labelled = [_has_poses(e) and scene_fraction(e.scene) <= share for e in episodes]
    known = {episode.task for episode, yes in zip(episodes, labelled, strict=True) if yes}
    without = {episode.task for episode in episodes} - known
    if without:
        raise InvalidInputError(
            f"--labelled-share {settings.labelled_share:g}: leaves no scene with known objects of "
            f"{', '.join(sorted(without))} to train on; choose a larger share, a smaller "
            "--heldout-share, or click the objects of more episodes"
        )
    return labelled


def _sources(episodes: Sequence[EpisodeGrid]) -> dict[str, int]:
    """Number of episodes with poses of objects from each source, and without any ("none")."""
    tracks = [one.objects for one in episodes if one.object_names and one.objects is not None]
    each = [{*track.sources} - {"none"} or {"none"} for track in tracks]
    return dict(sorted(Counter(source for sources in each for source in sources).items()))


def _seed_ranges(episodes: Sequence[EpisodeGrid], base: Base | None) -> dict[str, tuple[int, int]]:
    """First and last seed of every task, the base's included; recordings have none."""
    known = {} if base is None else base.checkpoint.metadata.training_seeds
    seeds = {task: list(ends) for task, ends in known.items()}
    for episode in episodes:
        if episode.about.seed is not None:
            seeds.setdefault(episode.task, []).append(episode.about.seed)
    return {task: (min(found), max(found)) for task, found in sorted(seeds.items())}


def _recorded_scenes(episodes: Sequence[EpisodeGrid], base: Base | None) -> tuple[str, ...]:
    """Digests of the scenes without a seed, the base's included."""
    known = set() if base is None else set(base.checkpoint.metadata.training_scenes)
    own = {scene_digest(episode.scene) for episode in episodes if episode.about.seed is None}
    return tuple(sorted(known | own))


def _splits(settings: StateTrainSettings, base: Base | None) -> tuple[Split, ...]:
    """Splits that the run and its base were trained on; none means all."""
    if base is None:
        return settings.splits
    known = base.checkpoint.metadata.training_splits
    if not (settings.splits and known):
        return ()
    return tuple(split for split in SPLITS if split in {*settings.splits, *known})


def _codec(table: SceneTable, config: DynamicsConfig, base: Base | None) -> TouchCodec:
    """The base's touch codec, or one fitted to the training episodes."""
    codec = TouchCodec(config.touch_channels)
    if base is None:
        touch_kpa = table.tactile_kpa[:, ::4].float().flatten(0, 2)
        codec.fit(touch_kpa, peak_kpa=float(table.tactile_kpa.max()))
    else:
        codec.load_state_dict(base.checkpoint.dynamics.codec.state_dict())
    return codec


def _prefixed(codec: TouchCodec) -> dict[str, Tensor]:
    return {f"codec/{name}": value for name, value in codec.state_dict().items()}


def _train_parts(work: _Work) -> None:
    """Train missing parts, several in parallel."""
    members = range(work.settings.num_members)
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(work.settings.jobs, spawned) as pool:
        orders = []
        if not (work.reads_starts or work.settings.keep_readers):
            orders += [pool.submit(_train_reader, work, m) for m in members]
        orders += [pool.submit(_train_core, work, m) for m in members]
        if work.base is None and not work.renderer_file.exists():
            orders.append(pool.submit(_train_renderer, work))
        for done in as_completed(orders):
            done.result()


def _train_renderer(work: _Work) -> None:
    torch.set_num_threads(1)
    settings = work.settings
    episodes, _ = split_by_scene(_episodes(settings), held_out_share=settings.heldout_share)
    rng = np.random.default_rng(settings.seed)
    episodes = [
        e for e, known in zip(episodes, _labelled(episodes, settings), strict=True) if known
    ]
    chosen = rng.permutation(len(episodes))[:MAX_CLIPS]
    clips = scene_clips([episodes[index] for index in sorted(chosen)])
    lines = ProgressLines("train renderer", has_bar=False)

    def on_progress(now: RendererProgress) -> None:
        lines.show(f"{now.share:.0%}  step {now.step}  loss {now.loss:.4f}")

    trained = train_renderer(
        clips, settings.renderer, settings.drawing, rng=rng, on_progress=on_progress
    )
    _keep(trained.network, work.renderer_file, trained.cpu_s)


def _keep(model: nn.Module, path: Path, cpu_s: float) -> None:
    """Write a finished part with its CPU seconds."""
    write_tensors(path, model.state_dict(), {_CPU_S: str(cpu_s)})


def _load(model: nn.Module, path: Path) -> float:
    """Load a finished part; returns its CPU seconds."""
    tensors, notes = read_tensors(path, f"finished part {path.name}")
    model.load_state_dict(tensors)
    return float(notes[_CPU_S])


def _table(work: _Work) -> tuple[SceneTable, TouchCodec]:
    """The training data as kept for the processes of the parts."""
    torch.set_num_threads(1)
    flat = load_file(work.parts / "table.safetensors")
    codec = TouchCodec(work.config.touch_channels)
    codec.load_state_dict(
        {k.removeprefix("codec/"): flat.pop(k) for k in list(flat) if k.startswith("codec/")}
    )
    return SceneTable.from_tensors(flat), codec


def _train_reader(work: _Work, member: int) -> None:
    if work.reader_file(member).exists():
        return
    table, _ = _table(work)
    started_s = time.process_time()
    on_step = _on_step(member, "reader")
    seed = work.settings.seed * _SEED_STRIDE + member
    settings, base = work.settings.reader, work.base
    initial = None if base is None else base.reader(work.config, member, seed=seed)
    trained = train_reader(
        table, work.config, settings, seed=seed, on_step=on_step, initial=initial
    )
    _keep(trained, work.reader_file(member), time.process_time() - started_s)


def _train_core(work: _Work, member: int) -> None:
    """Train a core; before it, the reader that it needs where episodes have no labels."""
    if work.core_file(member).exists():
        return
    readings: dict[int, Reading] = {}
    starts_read = work.settings.keep_readers
    if work.reads_starts and not starts_read:
        _train_reader(work, member)
    table, codec = _table(work)
    started_s = time.process_time()
    if work.reads_starts or starts_read:
        reader = _finished_reader(work, member)
        readings = {step: read_step(reader, table, step) for step in start_steps(table)}
    data = CoreData(table, touch_latents(codec, table), readings, starts_read)
    on_step = _on_step(member, "core")
    seed = work.settings.seed * _SEED_STRIDE + member
    initial = None if work.base is None else work.base.core(work.config, member, seed=seed)
    core = train_core(
        data, work.config, work.settings.core, seed=seed, on_step=on_step, initial=initial
    )
    _keep(core, work.core_file(member), time.process_time() - started_s)


def _finished_reader(work: _Work, member: int) -> StartReader:
    if work.base is not None and work.settings.keep_readers:
        return work.base.checkpoint.dynamics.readers()[member].eval()
    reader = StartReader(work.config)
    _load(reader, work.reader_file(member))
    return reader.eval()


def _on_step(member: int, part: str) -> OnStep:
    """Shows how far a part of a member is."""
    lines = ProgressLines(f"train member {member} {part}", has_bar=False)

    def on_step(step: int, loss: float) -> None:
        lines.show(f"step {step}  loss {loss:.4f}")

    return on_step


def _assembled(work: _Work, codec: TouchCodec) -> tuple[DynamicsModel, RendererNetwork, float]:
    """Models of the finished parts, and the CPU seconds of all of these."""
    dynamics = DynamicsModel(work.config, work.settings.num_members)
    dynamics.codec.load_state_dict(codec.state_dict())
    cpu_s = 0.0
    cores = [RecurrentCore(work.config) for _ in range(work.settings.num_members)]
    for index, (reader, core) in enumerate(zip(dynamics.readers(), cores, strict=True)):
        if work.base is not None and work.settings.keep_readers:
            reader.load_state_dict(work.base.checkpoint.dynamics.readers()[index].state_dict())
        else:
            cpu_s += _load(reader, work.reader_file(index))
        cpu_s += _load(core, work.core_file(index))
    dynamics.core.load_state_dict(_together(cores))
    renderer = RendererNetwork(work.settings.renderer)
    if work.base is None:
        cpu_s += _load(renderer, work.renderer_file)
    else:
        renderer.load_state_dict(work.base.checkpoint.renderer.state_dict())
    return dynamics.eval().requires_grad_(requires_grad=False), renderer, cpu_s


def _together(cores: Sequence[RecurrentCore]) -> dict[str, Tensor]:
    """Weights of cores of one member each as those of one core with all members."""
    weights = [dict(core.named_parameters()) for core in cores]
    shared = dict(cores[0].named_buffers())
    return shared | {name: torch.cat([each[name] for each in weights]) for name in weights[0]}


def _command(settings: StateTrainSettings) -> str:
    """Command that repeats a run; stores and the base are given by their last path component."""
    left_out = {"output", "episodes", "base", "clicks", "jobs", "json_path"}
    given = settings.model_dump(mode="json", exclude_defaults=True, exclude=left_out)
    flags = [f"--episodes={last_name(url)}" for url in settings.episodes]
    files = {"base": settings.base, "clicks": settings.clicks}
    flags += [f"--{name}={path.name}" for name, path in files.items() if path is not None]
    return " ".join(["dextouch train state", *flags, *flags_of(given)])
