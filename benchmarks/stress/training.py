"""Stress of training: losses and steps on corrupt, untouched and saturated windows."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import gettempdir

import numpy as np
import torch

from benchmarks.stress.cells import Check, StageCells
from benchmarks.stress.worlds import demonstration
from dextouch.errors import DegenerateRotationError, InvalidInputError, NonFiniteError
from services.world_model.network.configuration import NetworkConfig, Precision
from services.world_model.network.flow_matching import MIN_TIME, training_times
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.paper_settings import OptimizerSettings, TrainSettings, WindowSettings
from services.world_model.training.episode_sets import check_disjoint
from services.world_model.training.joint_dataset import EpisodeArrays, WindowBatch, WindowSampler
from services.world_model.training.joint_objective import Losses, LossOptions, errors, examples_of
from services.world_model.training.joint_trainer import TrainingRun

STAGE = StageCells("training")
_PX = 32
_STEPS = 33
_PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")
# Products of bfloat16 have eight bits.
_BFLOAT16_LOSS = 0.02


@STAGE.cell("rotations", "an action of parallel columns; wrists that turn by π", slow=True)
def _rotations(check: Check) -> None:
    for columns, is_taken in (([1.0, 0, 0, 1.0, 5e-7, 0], False), ([-1.0, 0, 0, 0, -1.0, 0], True)):
        actions = _episode().actions["measured"].copy()
        actions[7:, 3:9] = columns
        broken = replace(_episode(), actions={"measured": actions, "commanded": actions})
        if is_taken:
            check.finite("losses", np.array(_run(broken).learn(_batch_of(broken, 8))))
        else:
            check.refused("parallel columns", _batch_of, broken, 8, kind=DegenerateRotationError)


@STAGE.cell("non_finite", "NaN and infinity in true touch and in a weight", slow=True)
def _non_finite(check: Check) -> None:
    for bad in (float("nan"), float("inf")):
        batch = _batch_of(_episode(), 4)
        touch = batch.tactile_kpa.clone()
        touch[0, 3, 0, 5] = bad
        run = _run(_episode())
        before = [weight.clone() for weight in run.model.parameters()]
        broken = replace(batch, tactile_kpa=touch)
        check.refused(f"touch {bad}", run.learn, broken, kind=NonFiniteError)
        same = all(torch.equal(a, b) for a, b in zip(before, run.model.parameters(), strict=True))
        check.true("no weight moved", same)
    run = _run(_episode())
    with torch.no_grad():
        next(run.model.parameters()).view(-1)[0] = float("nan")
    check.refused("a weight NaN", run.learn, _batch_of(_episode(), 4), kind=NonFiniteError)


@STAGE.cell("touch", "windows of 0, 650 and 99 999 kPa, and of no valid sample", slow=True)
def _touch(check: Check) -> None:
    for pressure_kpa in (0.0, 650.0, 99_999.0):
        touch = np.full_like(_episode().tactile_kpa, pressure_kpa)
        run = _run(replace(_episode(), tactile_kpa=touch))
        check.finite(
            "losses", np.array(run.learn(_batch_of(replace(_episode(), tactile_kpa=touch), 4)))
        )
    run = _run(_episode())
    batch = _batch_of(_episode(), 4)
    nothing = replace(batch, tactile_valid=torch.zeros_like(batch.tactile_valid))
    check.at_most("loss of touch that nobody measured", run.learn(nothing)[1], 0.0)
    _check_weights(check, run.model)


@STAGE.cell("ends", "10 000 flow times; gradients at the earliest and at 1", slow=True)
def _ends(check: Check) -> None:
    times = training_times(10_000, shift=5.0, generator=torch.Generator().manual_seed(0))
    check.true("times in 0.001 … 1", float(times.min()) >= MIN_TIME and float(times.max()) <= 1)
    run = _run(_episode())
    batch = _batch_of(_episode(), 4)
    inputs = build_inputs(batch.requests, run.settings.network)
    target = run.model.targets(batch.images, batch.tactile_kpa)
    for t in (MIN_TIME, 1.0):
        guess = run.model(inputs, run.model.first_latents(inputs), target, torch.full((4,), t))
        loss = (guess.video - target.video).square().mean()
        run.model.zero_grad()
        torch.autograd.backward(loss)
        grads = [w.grad.abs().max() for w in run.model.parameters() if w.grad is not None]
        check.finite(f"gradients at t = {t:g}", torch.stack(grads).numpy())
    check.refused(
        "episodes shorter than a window",
        lambda: WindowSampler([_episode()], np.random.default_rng(0), max_steps=65),
    )
    check.refused(
        "held-out among trained", check_disjoint, [_episode()], [_episode()], kind=InvalidInputError
    )


@STAGE.cell("long_run", "1000 steps of a small network on one scene that moves", slow=True)
def _long_run(check: Check) -> None:
    # A static scene has nothing to learn: the first loss of its images is already 0.
    moving = [np.roll(image, step, axis=1) for step, image in enumerate(_episode().images)]
    run = _run(replace(_episode(), images=np.stack(moving)), max_steps=1000)
    log = run.run()
    first, last = log[0], log[-1]
    check.true("1000 steps", last.step == 1000)
    check.finite("losses", np.array([[one.loss_video, one.loss_tactile] for one in log]))
    check.at_most("last loss of images over the first", last.loss_video / first.loss_video, 1.0)
    run.whole_average()
    _check_weights(check, run.model)


@STAGE.cell("batch", "guesses of four windows at once and one by one", slow=True)
def _batch(check: Check) -> None:
    run = _run(_episode())
    model = run.model.eval()
    batch = _batch_of(_episode(), 4)
    inputs = build_inputs(batch.requests, run.settings.network)
    target = model.targets(batch.images, batch.tactile_kpa)
    t = torch.tensor([0.1, 0.4, 0.7, 1.0])
    with torch.no_grad():
        together = model(inputs, model.first_latents(inputs), target, t)
        for index in range(4):
            one = build_inputs(batch.requests[index : index + 1], run.settings.network)
            part = type(target)(target.video[index : index + 1], target.tactile[index : index + 1])
            alone = model(one, model.first_latents(one), part, t[index : index + 1])
            off = float((alone.video[0] - together.video[index]).abs().max())
            check.at_most("guesses differ", off, 1e-4)
    pair = [_losses(model, batch, generator=torch.Generator().manual_seed(1)) for _ in "ab"]
    check.equal(
        "the same seed, the same loss",
        pair[0].video.detach().numpy(),
        pair[1].video.detach().numpy(),
    )


@STAGE.cell("precision", "losses with matrix products in bfloat16", slow=True)
def _precision(check: Check) -> None:
    run = _run(_episode())
    # Outputs begin at zero, exact in every precision.
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in run.model.parameters():
            weight.add_(0.05 * torch.randn(weight.shape, generator=generator))
    batch = _batch_of(_episode(), 4)
    exact, coarse = (
        _losses(
            run.model,
            batch,
            generator=torch.Generator().manual_seed(1),
            options=LossOptions(precision=precision),
        )
        for precision in _PRECISIONS
    )
    off = abs(coarse.video.item() / exact.video.item() - 1.0)
    check.at_most("loss of images off", off, _BFLOAT16_LOSS)
    check.finite("loss of touch", coarse.tactile.detach().numpy())


@STAGE.cell("device", "losses and gradients on the meta device, where other tensors are found out")
def _device(check: Check) -> None:
    run = _run(_episode())
    batch = _batch_of(_episode(), 4)
    model = run.model.to("meta")
    loss = _losses(model, batch, generator=torch.Generator().manual_seed(1))
    torch.autograd.backward(loss.video + loss.tactile)
    check.true("losses stay there", loss.video.is_meta and loss.tactile.is_meta)


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion; see hand-eye",
    clock="windows are cut by steps; see resampling",
)


def _losses(
    model: JointWorldModel,
    batch: WindowBatch,
    *,
    generator: torch.Generator,
    options: LossOptions = LossOptions(),  # noqa: B008 - immutable
) -> Losses:
    examples = examples_of(model, batch, generator=generator, options=options)
    return errors(model, examples, options.precision)


@cache
def _episode() -> EpisodeArrays:
    """A static scene of the twin with a moving hand and some touch."""
    take = demonstration(_PX)
    start, observation = take.policy_start, take.observation
    rows = np.concatenate([observation.action_reached, take.actions[: _STEPS - 1]])
    touch = np.random.default_rng(0).uniform(0, 20, (_STEPS, 2, 320)).astype(np.float32)
    return EpisodeArrays(
        episode_id="stress",
        task=start.task,
        instruction=start.instruction,
        scene=f"{start.task}/{start.seed}",
        images=np.repeat(observation.images["camera_head"], _STEPS, axis=0),
        tactile_kpa=touch,
        tactile_valid=np.ones((_STEPS, 2), dtype=np.bool_),
        actions={"measured": rows, "commanded": rows},
        anchor=start.anchor,
        K_head=start.K_head,
        model_rate_hz=15.0,
        content_sha256="0" * 64,
    )


def _run(episode: EpisodeArrays, max_steps: int = 1) -> TrainingRun:
    """A small network before its first training step."""
    settings = TrainSettings(
        episodes="stress",
        output=Path(gettempdir()) / "stress.safetensors",
        network=NetworkConfig(
            image_px=_PX,
            video_width=32,
            tactile_width=32,
            num_layers=1,
            num_heads=2,
            head_width=16,
            codec_channels=12,
            palm_channels=8,
        ),
        optimizer=OptimizerSettings(batch=4, warmup_steps=10),
        windows=WindowSettings(fit_windows=8),
        max_steps=max_steps,
    )
    clean = replace(episode, actions=_episode().actions)
    run = TrainingRun([clean], settings)
    run.fit_codecs()
    return run


def _check_weights(check: Check, model: torch.nn.Module) -> None:
    check.finite(
        "weights", torch.nn.utils.parameters_to_vector(model.parameters()).detach().numpy()
    )


def _batch_of(episode: EpisodeArrays, num_windows: int) -> WindowBatch:
    return WindowSampler([episode], np.random.default_rng(1), max_steps=17).draw(num_windows, 17)
