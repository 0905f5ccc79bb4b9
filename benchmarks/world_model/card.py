"""The stage `gpu`: one card trains and serves the model of the full size with random weights."""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.figures import Figure, at_least, at_most
from benchmarks.report import ResultTable, StageReport, cells
from benchmarks.stages import Bar
from dextouch.errors import UnavailableError
from dextouch.geometry import pinhole_matrix
from dextouch.hands.actions import HandTrajectory, actions_from_poses
from services.networks.weight_files import on_device
from services.world_model.network.codecs import WanVideoCodec
from services.world_model.network.configuration import NetworkConfig, WanFiles
from services.world_model.network.inputs import ModelInputs, build_inputs
from services.world_model.network.instruction import key_of
from services.world_model.network.model import JointLatents, JointWorldModel, Sampling
from services.world_model.paper_settings import LoraSettings, TrainCommand, TrainSettings
from services.world_model.plan import plan_of, training_plan
from services.world_model.pretrained_video import initial_model
from services.world_model.training.joint_dataset import (
    EpisodeArrays,
    WindowBatch,
    WindowPosition,
    stack_windows,
)
from services.world_model.training.joint_trainer import TrainingRun

# Dense bfloat16 products of one H100 or H200 SXM (NVIDIA's data sheets), in TFLOP/s.
_PEAK_TFLOPS: Final = 989.0
# Chosen: bfloat16 has eight bits of mantissa, and two layers add some roundings.
_PARITY: Final = 0.05
_INSTRUCTION: Final = "stand the bottle"


class _Chunk(NamedTuple):
    """A way to compute a chunk of `batch` rollouts."""

    sampling: Sampling
    all_images: bool = False
    window: int | None = None
    batch: int = 1


_CHUNKS: Final = {
    "4 steps, all images": _Chunk(Sampling(4), all_images=True),
    "4 steps, last image": _Chunk(Sampling(4)),
    "4 steps, nothing shared": _Chunk(Sampling(4, keep_context=False)),
    "4 steps, last image of 3 latents": _Chunk(Sampling(4), window=3),
    "4 steps, last image of 2 latents": _Chunk(Sampling(4), window=2),
    "2 steps, last image": _Chunk(Sampling(2)),
    "1 step, last image": _Chunk(Sampling(1)),
    "1 step, last image of 2 latents": _Chunk(Sampling(1), window=2),
    "4 steps, last image, 8 rollouts": _Chunk(Sampling(4), batch=8),
    "1 step, last image, 8 rollouts": _Chunk(Sampling(1), batch=8),
}
_FASTEST: Final = "1 step, last image, 8 rollouts"


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    add = parser.add_argument
    add("--device", default="cuda", help="torch device (%(default)s)")
    add("--preset", default="wan22-5b", help="preset of the model (%(default)s)")
    add("--steps", type=int, default=20, help="training steps (%(default)s)")
    add("--rounds", type=int, default=5, help="times that a chunk is computed (%(default)s)")
    peak = "bfloat16 TFLOP/s of the card's data sheet (%(default)s: H100, H200)"
    add("--peak-tflops", type=float, default=_PEAK_TFLOPS, help=peak)


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Compare precisions, then time chunks and training steps, and compare memory with plans.

    Raises UnavailableError without the device.
    """
    device, preset = options.device, options.preset
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UnavailableError(
            "gpu: torch finds no CUDA device here, so nothing was run; to try the steps on "
            "processors: python -m benchmarks gpu --quick --device cpu --preset wan-tiny"
        )
    steps, rounds = (2, 1) if options.quick else (options.steps, options.rounds)
    given = TrainCommand(preset=preset, episodes="unused", device=device, init=folder / "random")
    half = _in_precision(given.network, "bfloat16")
    episode = _episode(half.image_px, half.max_steps)
    with bar(f"{preset} on {device}", 4) as step:
        step("parity")
        parity = _parity(given.network, device, episode)
        step("chunks")
        chunks = _chunks(half, device, episode, rounds)
        trained = {}
        for name, changed in _trainings(given, half).items():
            step(f"training, {name}")
            trained[name] = _training(changed, episode, steps)
    is_card = device.startswith("cuda")
    share = max(row.tflops for row in trained.values()) / options.peak_tflops
    images = half.max_steps - 1
    rate = images * _CHUNKS[_FASTEST].batch / chunks[_FASTEST].seconds.median
    rows = [*chunks.values(), *trained.values()]
    over = [one.peak_gb / one.planned_gb for one in rows if one.peak_gb is not None]
    requirements = [
        at_most("bfloat16 against float32, relative", parity, _PARITY),
        at_least("images of 8 rollouts", rate if is_card else None, 12.0, "1/s"),
        at_least("training, of the card's peak", share if is_card else None, 0.6),
        at_most("memory over plan", max(over, default=None), 1.2),
    ]
    return StageReport(
        stage="gpu",
        packages=("torch", "diffusers"),
        options={"device": device, "preset": preset, "steps": steps, "rounds": rounds},
        tables=_tables(chunks, trained, images),
        requirements=requirements,
        data={"chunks": chunks, "training": trained, "parity": parity},
        notes=[
            _name_of(device),
            "weights and episodes are random; memory is measured on CUDA only",
        ],
    )


class _Measured(NamedTuple):
    """Seconds of a computation, its counted TFLOP, and its memory, of a card, beside the plan's."""

    seconds: Figure
    tflop: float
    peak_gb: float | None = None
    planned_gb: float = 0.0

    @property
    def tflops(self) -> float:
        """TFLOP/s."""
        return self.tflop / self.seconds.median


def _tables(
    chunks: dict[str, _Measured], trained: dict[str, _Measured], images: int
) -> list[ResultTable]:
    def row(name: str, one: _Measured, *more: float) -> tuple[str, ...]:
        peak = ("-",) if one.peak_gb is None else cells(one.peak_gb)
        work = cells(one.seconds, *more, one.tflop, one.tflops)
        return (name, *work, *peak, *cells(one.planned_gb))

    served = [
        row(name, one, images * _CHUNKS[name].batch / one.seconds.median)
        for name, one in chunks.items()
    ]
    units = ("TFLOP", "TFLOP/s", "memory (GB)", "planned (GB)")
    steps = [row(name, one) for name, one in trained.items()]
    return [
        ResultTable("Chunks in bfloat16", ("chunk", "s", "images/s", *units), served),
        ResultTable("Training steps", ("training", "s", *units), steps),
    ]


def _name_of(device: str) -> str:
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def _in_precision(network: NetworkConfig, precision: str) -> NetworkConfig:
    if network.wan is None:
        return network
    wan = network.wan.model_copy(update={"precision": precision})
    return network.model_copy(update={"wan": wan})


def _trainings(given: TrainCommand, half: NetworkConfig) -> dict[str, TrainSettings]:
    """Trainings that fit one card."""
    lean = given.model_copy(
        update={"network": half, "recompute": True, "accumulate": given.optimizer.batch}
    )
    return {
        "LoRA of rank 32": lean.model_copy(update={"lora": LoraSettings(rank=32)}).with_adapters(),
        "touch and actions alone": lean.model_copy(update={"freeze_video": True}),
    }


def _parity(network: NetworkConfig, device: str, episode: EpisodeArrays) -> float:
    """RMS of what bfloat16 changes in the latents of two layers, over their own."""
    few = network.model_copy(update={"num_layers": 2})
    latents = []
    for precision in ("float32", "bfloat16"):
        model = _model(_in_precision(few, precision), device)
        inputs, noise = _asked(model, episode, 1)
        inputs, noise = inputs.to(model.device), _moved(noise, model.device)
        latents.append(
            model.sample(inputs, model.first_latents(inputs), noise, Sampling(1)).video.float()
        )
        del model
    return float(
        (latents[1] - latents[0]).square().mean().sqrt() / latents[0].square().mean().sqrt()
    )


def _chunks(
    network: NetworkConfig, device: str, episode: EpisodeArrays, rounds: int
) -> dict[str, _Measured]:
    model, planned = _model(network, device), plan_of(network)
    weights = sum(one.memory_bytes for one in planned.parts)
    # The text encoder is not loaded.
    encoder = sum(one.memory_bytes for one in planned.parts if one.name.startswith("text encoder"))
    found = {}
    for name, chunk in _CHUNKS.items():
        if isinstance(model.codec, WanVideoCodec):
            model.codec.window = chunk.window
        inputs, noise = _asked(model, episode, chunk.batch)
        compute = partial(
            model.predict, inputs, noise, sampling=chunk.sampling, all_images=chunk.all_images
        )
        measured = _timed(compute, device, rounds)
        planned_bytes = weights - encoder + chunk.batch * (planned.peak_bytes - weights)
        found[name] = measured._replace(planned_gb=planned_bytes / 1e9)
    return found


def _training(settings: TrainSettings, episode: EpisodeArrays, num_steps: int) -> _Measured:
    run = TrainingRun([episode], settings)
    _randomize(run.model)
    run.model.train()
    batch = _batch(episode, settings)

    def step() -> object:
        run.budget.advance()
        return run.learn(batch)

    measured = _timed(step, settings.device, num_steps)
    return measured._replace(planned_gb=training_plan(settings).peak_bytes / 1e9)


def _timed(compute: Callable[[], object], device: str, rounds: int) -> _Measured:
    """Seconds of each round after a first one, whose FLOPs are counted."""
    is_card = device.startswith("cuda")
    wait = torch.cuda.synchronize if is_card else lambda: None
    if is_card:
        torch.cuda.reset_peak_memory_stats()
    with FlopCounterMode(display=False) as counter:
        compute()
    seconds = []
    for _ in range(rounds):
        wait()  # type: ignore[no-untyped-call]
        start_s = time.perf_counter()
        compute()
        wait()  # type: ignore[no-untyped-call]
        seconds.append(time.perf_counter() - start_s)
    peak_gb = torch.cuda.max_memory_allocated() / 1e9 if is_card else None
    return _Measured(Figure.of(seconds), counter.get_total_flops() / 1e12, peak_gb)


def _model(network: NetworkConfig, device: str) -> JointWorldModel:
    model = initial_model(network, WanFiles(), filled_later=True)
    return _randomize(on_device(model, device)).eval()


@torch.no_grad()
def _randomize(model: JointWorldModel) -> JointWorldModel:
    """Weights that keep the size of what passes through, equal in every precision."""
    draw = torch.Generator().manual_seed(0)
    for name, weight in model.named_parameters():
        if weight.ndim < 2:
            nn.init.constant_(weight, 0.0 if name.endswith("bias") else 1.0)
            continue
        values = torch.randn(weight.shape, generator=draw) / math.sqrt(weight[0].numel())
        weight.copy_(values)
    if model.text_features is not None and model.config.wan is not None:
        words = torch.randn(8, model.config.wan.text_width, generator=draw)
        model.text_features.learn({key_of(_INSTRUCTION): words})
    return model


def _asked(
    model: JointWorldModel, episode: EpisodeArrays, batch: int
) -> tuple[ModelInputs, JointLatents]:
    num_steps, draw = model.config.max_steps, torch.Generator().manual_seed(1)
    requests = [episode.cut(WindowPosition(0, i, num_steps)).request for i in range(batch)]
    noise = [model.noise(num_steps, draw) for _ in requests]
    together = JointLatents(
        torch.cat([one.video for one in noise]), torch.cat([one.tactile for one in noise])
    )
    return build_inputs(requests, model.config), together


def _moved(noise: JointLatents, device: torch.device) -> JointLatents:
    return replace(noise, video=noise.video.to(device), tactile=noise.tactile.to(device))


def _batch(episode: EpisodeArrays, settings: TrainSettings) -> WindowBatch:
    num_steps = settings.network.max_steps
    starts = np.arange(settings.optimizer.batch) % (len(episode) - num_steps + 1)
    places = [WindowPosition(0, int(start), num_steps) for start in starts]
    return stack_windows([episode.cut(place) for place in places])


def _episode(image_px: int, max_steps: int) -> EpisodeArrays:
    """Noise seen and felt by hands that hold still."""
    steps, draw = max_steps + 16, np.random.default_rng(0)
    still, joints = np.tile(np.eye(4), (steps, 1, 1)), np.zeros((steps, 20))
    hands = HandTrajectory(still, still, joints, joints, still)
    return EpisodeArrays(
        episode_id="random",
        task="random",
        instruction=_INSTRUCTION,
        scene="random/0",
        images=draw.integers(0, 256, (steps, image_px, image_px, 3), dtype=np.uint8),
        tactile_kpa=draw.uniform(0.0, 50.0, (steps, 2, 320)).astype(np.float32),
        tactile_valid=np.ones((steps, 2), dtype=np.bool_),
        actions={"measured": actions_from_poses(hands, hands.anchor(0))},
        anchor=hands.anchor(0),
        K_head=pinhole_matrix(width_px=image_px, height_px=image_px, fovy_rad=1.0),
        model_rate_hz=15.0,
        content_sha256="0" * 64,
    )
