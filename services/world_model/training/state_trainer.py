"""Training of a state model, whose parts are trained in processes, and stored to be resumed."""

import hashlib
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from dextouch.episodes import data_hash
from dextouch.errors import InvalidInputError
from dextouch.jobs import worker_pool
from services.networks.training_settings import USUAL_IMAGE_PX
from services.networks.weight_files import read_tensors, write_tensors
from services.world_model.checkpoints import (
    StateBounds,
    StateMetadata,
    scene_digest,
    write_state_checkpoint,
)
from services.world_model.dynamics.core import RecurrentCore
from services.world_model.dynamics.features import STEPS_PER_LATENT, DynamicsConfig, TouchCodec
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.dynamics.start_reader import Reading, StartReader
from services.world_model.rendering.renderer import RendererNetwork, uses_bfloat16
from services.world_model.rendering.training import train_renderer
from services.world_model.settings import StateAdaptSettings, StateTrainSettings, recorded_command
from services.world_model.training import member_training, state_data
from services.world_model.training.episode_sets import training_sets
from services.world_model.training.evaluation import check_long_enough, evaluate_dynamics
from services.world_model.training.scene_table import (
    SceneTable,
    scene_clips,
    scene_table,
    usual_boxes_m,
)
from services.world_model.training.transfer import Base

# Increment when a change of training gives other weights for the same settings and data.
READER_VERSION, CORE_VERSION, RENDERER_VERSION = 6, 10, 3
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
    if settings.init is None and settings.learn != "all":
        raise InvalidInputError(
            f"training: got --learn {settings.learn} without --init; add --init PATH"
        )
    settings = _with_precision(settings)
    command = _command(settings)
    data = state_data.load_state_data(settings)
    training, heldout = data.training, data.heldout
    base = None if settings.init is None else Base(settings.init)
    config = state_data.configured(data, settings, base)
    state_data.check_new(data, settings, base)
    if base is not None:
        settings = _with_base(base, config, settings)
        config = base.configured(config, keeps_tasks=settings.learn == "success")
    parts = settings.output.with_suffix(".parts")
    hashed = data_hash((e.content_sha256 for e in training), image_px=_unusual_px(settings))
    # Before training, so that invalid episodes are found at once.
    heldout_table, labelled = (
        scene_table(heldout, config),
        state_data.labelled_episodes(training, settings),
    )
    check_long_enough(heldout_table)
    share = settings.share_of_human
    table = scene_table(training, config, labelled=labelled, human_share=share)
    if settings.learn == "all":
        state_data.check_drawable(state_data.drawn_episodes(data, settings))
    codec = _codec(table, config, base)
    is_known = all(bool(table.knows_all(step).all()) for step in member_training.start_steps(table))
    reads_starts = settings.labelled_share < 1 or not is_known or bool(table.touched.any())
    table_file = parts / "table.safetensors"
    codec_tensors = {f"codec/{name}": value for name, value in codec.state_dict().items()}
    write_tensors(table_file, {**table.tensors(), **codec_tensors}, {})
    # Of robots, if there are any.
    own = table.length[~table.human | table.human.all()]
    horizon_latents = (int(own.max()) - 1) // STEPS_PER_LATENT
    del table
    work = _Work(settings, config, parts, hashed, reads_starts)
    _train_parts(work)
    dynamics, renderer, cpu_s = _assembled(work, codec)
    metrics, bounds = evaluate_dynamics(dynamics, heldout_table)
    bounds = bounds.model_copy(update={"horizon_latents": horizon_latents})
    metadata = _metadata(work, data, bounds, metrics, command=command, cpu_s=cpu_s)
    digest = write_state_checkpoint(settings.output, dynamics, renderer, metadata)
    table_file.unlink()
    size = sum(p.numel() for p in (*dynamics.parameters(), *renderer.parameters()))
    return StateReport(settings.output, digest, size, cpu_s, len(training), len(heldout), metrics)


def _metadata(
    work: "_Work",
    data: state_data.StateData,
    bounds: StateBounds,
    metrics: dict[str, float],
    *,
    command: str,
    cpu_s: float,
) -> StateMetadata:
    settings, base = work.settings, work.base
    keeps_bounds = base is not None and settings.learn != "all"
    # Recordings have no seed.
    scenes = {scene_digest(one.scene) for one in data.training if one.about.seed is None}
    scenes |= set() if base is None else set(base.checkpoint.metadata.training_scenes)
    return StateMetadata(
        name=settings.name,
        dynamics=work.config,
        num_members=settings.num_members,
        renderer=settings.renderer,
        **_objects(data, work.config, base),
        model_rate_hz=data.training[0].about.model_rate_hz,
        bounds=base.checkpoint.metadata.bounds if base and keeps_bounds else bounds,
        command=command,
        seed=settings.seed,
        training_cpu_s=round(cpu_s, 1),
        num_training_episodes=len(data.training),
        training_seeds=state_data.seed_ranges(data.training, base),
        training_splits=state_data.trained_splits(settings, base),
        task_splits=state_data.splits_by_task(data.training, settings, base),
        heldout_share=state_data.heldout_share(settings, base),
        training_scenes=tuple(sorted(scenes)),
        data_hash=work.data_hash,
        object_sources=state_data.object_sources(data.training),
        sets=training_sets(
            data.training,
            data.heldout,
            human_share=settings.share_of_human,
            image_px=_unusual_px(settings),
            inherited=() if base is None else base.checkpoint.metadata.sets,
            ancestor=None if base is None else base.checkpoint.digest,
        ),
        metrics=metrics,
    )


def _unusual_px(settings: StateTrainSettings) -> int | None:
    """Side of the images, for hashes; None if it is the usual one."""
    return None if settings.image_px == USUAL_IMAGE_PX else settings.image_px


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
        return None if self.settings.init is None else Base(self.settings.init)

    @property
    def keeps_readers(self) -> bool:
        """Whether the initial model's readers are kept."""
        return self.settings.learn == "success"

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
        # Which episodes are drawn depends on the share, if people are told from robots.
        drawn_by = ["human_share"] if self.settings.human else []
        chosen = self.settings.model_dump_json(
            include={"seed", "heldout_share", "labelled_share", *names, *drawn_by}
        )
        base = "" if self.base is None else f"{self.settings.learn} {self.base.checkpoint.digest}"
        # Which scenes are labelled depends on whether some of them are held out.
        is_split = self.settings.heldout is None
        text = f"{version} {chosen} {self.data_hash} {base} {self.config.domains} {is_split}"
        text += "".join(f" {sentence}" for sentence in self.config.instructions)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _objects(
    data: state_data.StateData, config: DynamicsConfig, base: Base | None
) -> dict[str, Any]:
    """Names and usual boxes of every task's objects; of tasks without episodes the base's."""
    names = {one.task: one.object_names for one in data.episodes}
    boxes_m = {
        task: tuple(tuple(map(float, row)) for row in rows)
        for task, rows in usual_boxes_m(data.episodes).items()
    }
    if base is not None:
        about = base.checkpoint.metadata
        for task in set(config.tasks) - names.keys():
            names[task], boxes_m[task] = about.object_names[task], about.object_boxes_m[task]
    return {"object_names": names, "object_boxes_m": boxes_m}


def _with_base(
    base: Base, config: DynamicsConfig, settings: StateTrainSettings
) -> StateTrainSettings:
    """Settings of a run that keeps the base's networks and trains no more of cores than success."""
    about = base.checkpoint.metadata
    if settings.learn == "success" and not base.has_tasks_of(config):
        raise InvalidInputError(
            f"--learn success: the episodes have tasks {', '.join(config.tasks)}, expected some "
            f"of --init, {', '.join(about.dynamics.tasks)}; --learn readers trains start readers "
            "for other tasks"
        )
    is_chosen = "num_members" in settings.model_fields_set
    if settings.learn == "all" and is_chosen:
        return settings.model_copy(update={"renderer": about.renderer})
    if is_chosen and settings.num_members != about.num_members:
        raise InvalidInputError(
            f"--num-members: got {settings.num_members}, expected {about.num_members}, as in "
            f"--init, since --learn {settings.learn} keeps its members; or leave the flag out"
        )
    shape = {"num_members": about.num_members, "renderer": about.renderer}
    if settings.learn == "all":
        return settings.model_copy(update=shape)
    nothing_else = dict.fromkeys(("objects", "touch", "contact", "taxels"), 0.0)
    only_success = settings.core.weights.model_copy(update=nothing_else)
    core = settings.core.model_copy(update={"weights": only_success})
    return settings.model_copy(update={**shape, "core": core})


def _with_precision(settings: StateTrainSettings) -> StateTrainSettings:
    """Settings that name the precision: it is chosen once, and part of the readers' keys."""
    chosen = {"bfloat16": uses_bfloat16(setting=settings.reader.bfloat16)}
    return settings.model_copy(update={"reader": settings.reader.model_copy(update=chosen)})


def _codec(table: SceneTable, config: DynamicsConfig, base: Base | None) -> TouchCodec:
    """The base's touch codec, or one fitted to the training episodes."""
    codec = TouchCodec(config.touch_channels, config.tactile_layout.num_taxels)
    if base is None:
        touch_kpa = table.tactile_kpa[:, ::4][table.felt[:, ::4]].float()
        codec.fit(touch_kpa, peak_kpa=float(table.tactile_kpa.max()))
    else:
        codec.load_state_dict(base.checkpoint.dynamics.codec.state_dict())
    return codec


def _train_parts(work: _Work) -> None:
    members = range(work.settings.num_members)
    with worker_pool(work.settings.jobs) as pool:
        orders = []
        if not (work.reads_starts or work.keeps_readers):
            orders += [pool.submit(_train_reader, work, m) for m in members]
        orders += [pool.submit(_train_core, work, m) for m in members]
        if work.settings.learn == "all" and not work.renderer_file.exists():
            orders.append(pool.submit(_train_renderer, work))
        for done in as_completed(orders):
            done.result()


def _train_renderer(work: _Work) -> None:
    torch.set_num_threads(1)
    settings = work.settings
    known = state_data.drawn_episodes(state_data.load_state_data(settings), settings)
    rng = np.random.default_rng(settings.seed)
    chosen = rng.permutation(len(known))[:MAX_CLIPS]
    clips = scene_clips([known[index] for index in sorted(chosen)])
    network, cpu_s = train_renderer(
        clips,
        settings.renderer,
        settings.drawing,
        rng=rng,
        title="train renderer",
        initial=None if work.base is None else work.base.checkpoint.renderer,
    )
    _keep(network, work.renderer_file, cpu_s)


def _keep(model: nn.Module, path: Path, cpu_s: float) -> None:
    write_tensors(path, model.state_dict(), {_CPU_S: str(cpu_s)})


def _load(model: nn.Module, path: Path) -> float:
    """Load a finished part; returns its CPU seconds."""
    tensors, notes = read_tensors(path, f"finished part {path.name}")
    model.load_state_dict(tensors)
    return float(notes[_CPU_S])


def _table(work: _Work) -> tuple[SceneTable, TouchCodec]:
    torch.set_num_threads(1)
    flat = load_file(work.parts / "table.safetensors")
    codec = TouchCodec(work.config.touch_channels, work.config.tactile_layout.num_taxels)
    codec.load_state_dict(
        {k.removeprefix("codec/"): flat.pop(k) for k in list(flat) if k.startswith("codec/")}
    )
    return SceneTable.from_tensors(flat), codec


def _train_reader(work: _Work, member: int) -> None:
    if work.reader_file(member).exists():
        return
    table, _ = _table(work)
    started_s, base = time.process_time(), work.base
    seed = work.settings.seed * _SEED_STRIDE + member
    trained = member_training.train_reader(
        table,
        work.config,
        work.settings.reader,
        seed=seed,
        title=f"train member {member} reader",
        initial=None if base is None else base.reader(work.config, member, seed=seed),
    )
    _keep(trained, work.reader_file(member), time.process_time() - started_s)


def _train_core(work: _Work, member: int) -> None:
    """Train a core; before it, the reader that it needs where episodes have no labels."""
    if work.core_file(member).exists():
        return
    readings: dict[int, Reading] = {}
    if work.reads_starts and not work.keeps_readers:
        _train_reader(work, member)
    table, codec = _table(work)
    started_s = time.process_time()
    if work.reads_starts or work.keeps_readers:
        if work.base is not None and work.keeps_readers:
            reader = work.base.checkpoint.dynamics.readers()[member]
        else:
            reader = StartReader(work.config)
            _load(reader, work.reader_file(member))
        reader.eval()
        readings = {
            step: member_training.read_step(reader, table, step)
            for step in member_training.start_steps(table)
        }
    data = member_training.CoreData(
        table, member_training.touch_latents(codec, table), readings, work.keeps_readers
    )
    seed, title = work.settings.seed * _SEED_STRIDE + member, f"train member {member} core"
    initial = None
    if work.base is not None:
        learns_all = work.settings.learn == "all"
        initial = work.base.core(work.config, member, seed=seed, learns_all=learns_all)
    core = member_training.train_core(
        data, work.config, work.settings.core, seed=seed, title=title, initial=initial
    )
    _keep(core, work.core_file(member), time.process_time() - started_s)


def _assembled(work: _Work, codec: TouchCodec) -> tuple[DynamicsModel, RendererNetwork, float]:
    """Models of the finished parts, and the CPU seconds of all of these."""
    dynamics = DynamicsModel(work.config, work.settings.num_members)
    dynamics.codec.load_state_dict(codec.state_dict())
    cpu_s = 0.0
    cores = [RecurrentCore(work.config) for _ in range(work.settings.num_members)]
    for index, (reader, core) in enumerate(zip(dynamics.readers(), cores, strict=True)):
        if work.base is not None and work.keeps_readers:
            reader.load_state_dict(work.base.checkpoint.dynamics.readers()[index].state_dict())
        else:
            cpu_s += _load(reader, work.reader_file(index))
        cpu_s += _load(core, work.core_file(index))
    dynamics.core.load_state_dict(_together(cores))
    renderer = RendererNetwork(work.settings.renderer)
    if work.base is not None and work.settings.learn != "all":
        renderer.load_state_dict(work.base.checkpoint.renderer.state_dict())
    else:
        cpu_s += _load(renderer, work.renderer_file)
    return dynamics.eval().requires_grad_(requires_grad=False), renderer, cpu_s


def _together(cores: Sequence[RecurrentCore]) -> dict[str, Tensor]:
    """One core's weights from cores of one member each."""
    weights = [dict(core.named_parameters()) for core in cores]
    shared = dict(cores[0].named_buffers())
    return shared | {name: torch.cat([each[name] for each in weights]) for name in weights[0]}


def _command(settings: StateTrainSettings) -> str:
    command = "adapt" if isinstance(settings, StateAdaptSettings) else "world-model"
    places = ("episodes", "human", "heldout", "init", "clicks")
    left_out = {"output", "jobs", "json_path"}
    return recorded_command(settings, f"dextouch train {command}", places, left_out)
