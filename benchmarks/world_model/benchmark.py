"""Entry point of the benchmark stage `world-model`."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.figures import Figure
from benchmarks.report import ResultTable, StageReport
from benchmarks.rounds import every_round, interleaved
from benchmarks.stages import Amounts, Bar
from benchmarks.world_model.held_out import HeldOut, held_out
from benchmarks.world_model.rollouts import Imagined, imagine, imagine_together, rollout_error
from benchmarks.world_model.tables import (
    COPY_FIRST,
    STATE_BATCHES,
    Variant,
    asked_name,
    error_table,
    panels,
    requirements,
    state_model_requirements,
    state_model_table,
)
from dextouch.errors import InvalidInputError
from dextouch.schemas import EVERYTHING, ReturnSelector
from dextouch.worlds import BatchWorld, CopyFirstWorld, World
from services.twin.tasks import TASK_NAMES
from services.world_model.checkpoints import read_checkpoint, read_state_checkpoint
from services.world_model.network.model import Sampling
from services.world_model.shipped_checkpoints import PRETRAINED, STATE_MODEL, paper_form_checkpoint
from services.world_model.state_world import StateWorld
from services.world_model.world import ModelWorld

# Of demonstrations that nothing is trained on.
FIRST_SEED: Final = 30_000
AMOUNTS: Final = Amounts(usual={"rounds": 7, "seeds": 6}, quick={"rounds": 1, "seeds": 1})
VARIANTS: Final = (
    *(Variant(steps) for steps in (1, 2, 4, 8)),
    *(Variant(steps, recomputed=True) for steps in (2, 4, 8)),
    *(Variant(steps, "unipc") for steps in (2, 4, 8)),
    *(Variant(steps, precision="bfloat16") for steps in (1, 2, 4)),
)
SELECTORS: Final = {
    "all images": EVERYTHING,
    "the last image": ReturnSelector(steps="last"),
    "no image": ReturnSelector(cameras=()),
}
TOGETHER: Final = (1, 4, 8)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument(
        "--checkpoint", type=Path, help="model in the paper's form (default: the package's own)"
    )
    parser.add_argument(
        "--state-model", type=Path, help="state model to time (default: the package's own)"
    )
    AMOUNTS.add_options(parser, rounds="rounds", seeds="episodes per task")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Predict held-out demonstrations with different settings, alternately."""
    plan = AMOUNTS.of(options)
    checkpoint = read_checkpoint(options.checkpoint or paper_form_checkpoint())
    network = checkpoint.metadata.network
    variants = {
        one.name: ModelWorld(
            checkpoint,
            sampling=Sampling(one.steps, one.sampler, keep_context=not one.recomputed),
            precision=one.precision,
        )
        for one in VARIANTS
    }
    served = Variant(network.sampling_steps, network.sampler).name
    world = variants.setdefault(served, ModelWorld(checkpoint))
    tasks = [task for task in TASK_NAMES if task in world.description.tasks]
    if not tasks:
        raise InvalidInputError(
            f"bench world-model: the model supports {world.description.tasks}, expected at least "
            f"one task of the twin: {TASK_NAMES}"
        )
    with bar("demonstrations of the twin", 1) as step:
        step("making")
        seeds = range(FIRST_SEED, FIRST_SEED + plan["seeds"])
        episodes = held_out(tasks, seeds, world.description.image_height_px)
    copied = CopyFirstWorld.beside(world.description)
    worlds: dict[str, World[Any]] = {COPY_FIRST: copied, **variants}
    errors = {name: rollout_error(imagine(one, episodes), episodes) for name, one in worlds.items()}
    imagining = {name: partial(imagine, one, episodes) for name, one in worlds.items()}
    times_ms = _times_ms(imagining, "steps and precision", plan["rounds"], bar)
    costs_ms = _costs_ms(world, episodes[:1], TOGETHER, plan["rounds"], bar)
    state_model = options.state_model or PRETRAINED / STATE_MODEL
    state_world = StateWorld(read_state_checkpoint(state_model))
    state_ms = _state_costs_ms(state_world, plan["rounds"], bar)
    return StageReport(
        stage="world-model",
        packages=("numpy", "torch", "mujoco-core"),
        options={**plan, "tasks": tasks, "checkpoint": world.description.name, "served": served},
        tables=[
            error_table(times_ms, errors, served, len(episodes)),
            ResultTable(
                f"{served}: a chunk of one rollout, by requested images and batch size",
                ("requested", "ms"),
                [(name, figure.text()) for name, figure in costs_ms.items()],
            ),
            state_model_table(state_ms, state_world.description.name),
        ],
        panels=panels(times_ms, errors, served),
        requirements=requirements(times_ms, errors, served) + state_model_requirements(state_ms),
        data={
            "chunk_ms": {name: list(figure.values) for name, figure in times_ms.items()},
            "errors": {name: asdict(error) for name, error in errors.items()},
            "asked_ms": {name: list(figure.values) for name, figure in costs_ms.items()},
            "state_model_ms": {name: list(figure.values) for name, figure in state_ms.items()},
        },
        notes=[
            "times are processor time of the whole process; OMP_NUM_THREADS=1 gives one thread",
            "every chunk starts from the predicted end of the previous one",
        ],
    )


def _times_ms(
    imagining: Mapping[str, Callable[[], Imagined]], what: str, num_rounds: int, bar: Bar
) -> dict[str, Figure]:
    subjects = {name: every_round(measured) for name, measured in imagining.items()}
    with bar(what, num_rounds * len(subjects)) as step:
        found = interleaved(subjects, num_rounds, on_step=step)
    return {name: Figure.of([one.ms for one in rounds]) for name, rounds in found.items()}


def _state_costs_ms(world: StateWorld, num_rounds: int, bar: Bar) -> dict[str, Figure]:
    """Milliseconds per chunk of the state model, with one demonstration of each of its tasks."""
    tasks = [task for task in TASK_NAMES if task in world.description.tasks]
    episodes = held_out(tasks, [FIRST_SEED], world.description.image_height_px)
    # Choice of precision, memory of the first images, and traces.
    for selector in SELECTORS.values():
        imagine_together(world, episodes, 1, selector)
    return _costs_ms(world, episodes, STATE_BATCHES, num_rounds, bar)


def _costs_ms(
    world: BatchWorld[Any],
    episodes: Sequence[HeldOut],
    batches: Sequence[int],
    num_rounds: int,
    bar: Bar,
) -> dict[str, Figure]:
    """Milliseconds per chunk of one rollout, by requested images and batch size."""
    imagining = {
        asked_name(asked, count): partial(imagine_together, world, episodes, count, selector)
        for count in batches
        for asked, selector in SELECTORS.items()
    }
    return _times_ms(imagining, "requested images and batch sizes", num_rounds, bar)
