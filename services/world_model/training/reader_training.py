"""Training of a start reader on steps whose object poses are known."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor
from torch.nn import functional

from dextouch.schemas import MAX_OBJECTS
from services.world_model.dynamics.configuration import DynamicsConfig
from services.world_model.dynamics.nested import combined
from services.world_model.dynamics.objects import ObjectPoses
from services.world_model.dynamics.start_reader import Reading, StartReader
from services.world_model.rendering.precision import uses_bfloat16
from services.world_model.settings import ReaderSettings
from services.world_model.training.augmentation import as_another_camera
from services.world_model.training.averaging import OnStep, train_averaged
from services.world_model.training.scene_table import SceneTable

# Unit of position errors in the loss.
_UNIT_M = 0.05
_BATCH_OF_READING = 128
_WEIGHT_DECAY = 1e-3
_SD_WEIGHT = 0.02
_SIZE_WEIGHT, _UNIT_LOG = 0.3, 0.1
# Of the first guess, which the correction starts from.
_GUESS_WEIGHT = 0.5


@dataclass(frozen=True)
class ReaderError:
    """Errors on held-out steps, of present objects: median and 90 % quantile in mm."""

    lateral_mm: float
    lateral_90_mm: float
    height_mm: float
    axis_deg: float
    presence: float


def train_reader(
    table: SceneTable,
    config: DynamicsConfig,
    settings: ReaderSettings,
    *,
    seed: int,
    on_step: OnStep | None = None,
    initial: StartReader | None = None,
) -> StartReader:
    """Train a reader of objects from single steps, both first and later ones.

    Args:
        table: training episodes; only labelled ones are used.
        config: of the dynamics model.
        settings: number of steps and so on.
        seed: seed of weights and sampling.
        on_step: called with the step and its loss.
        initial: reader to start from; its weights are changed.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        reader = initial or StartReader(config)
    _fit_heights(reader, table, config)
    later = [step for step in table.image_steps if step % 4 == 0 and step > 0]
    known = torch.nonzero(table.labelled)[:, 0]
    is_told = _knows_some(table, config)
    # Later steps of each episode, in their order; of further ones nothing is known, they have no
    # image or lie behind its end.
    reached = (torch.tensor(later) < table.length[:, None]) & table.shown[:, _places(table, later)]
    reached &= is_told[:, later]
    counts = reached.sum(1)
    order = torch.argsort(~reached, dim=1, stable=True)

    def loss() -> Tensor:
        rows = table.drawn(known, settings.batch, generator)
        drawn = torch.randint(len(later), rows.shape, generator=generator)
        amid = torch.tensor(later)[order[rows, drawn % counts[rows].clamp_min(1)]]
        is_first = torch.rand(rows.shape, generator=generator) < settings.first_fraction
        is_first &= is_told[rows, 0]
        steps = torch.where(is_first | (counts[rows] == 0), 0, amid)
        return _loss(
            reader,
            (table, rows, steps),
            generator,
            bfloat16=uses_bfloat16(setting=settings.bfloat16),
        )

    return train_averaged(reader, loss, settings, weight_decay=_WEIGHT_DECAY, on_step=on_step)


def _knows_some(table: SceneTable, config: DynamicsConfig) -> Bool[Tensor, "episodes steps"]:
    """Steps at which the pose of an object is known; all of tasks without objects."""
    count = torch.tensor(config.num_objects)[table.task]
    is_slot = torch.arange(MAX_OBJECTS) < count[:, None]
    return (table.objects_known & is_slot[:, None]).any(-1) | (count == 0)[:, None]


def _places(table: SceneTable, steps: list[int]) -> list[int]:
    """Indices of steps among those with images."""
    return [table.image_steps.index(step) for step in steps]


def _fit_heights(reader: StartReader, table: SceneTable, config: DynamicsConfig) -> None:
    """Fit resting heights: medians over the first steps of each task's episodes."""
    for task, count in enumerate(config.num_objects):
        for slot in range(count):
            first = table.objects.position_m[:, 0, slot, 2]
            there = (table.task == task) & (table.objects.present[:, 0, slot] > 0) & table.labelled
            there &= table.objects_known[:, 0, slot]
            if there.any():
                reader.height_mean[task, slot] = first[there].median()


def _loss(
    reader: StartReader,
    places: tuple[SceneTable, Int64[Tensor, " batch"], Int64[Tensor, " batch"]],
    generator: torch.Generator,
    *,
    bfloat16: bool,
) -> Float32[Tensor, ""]:
    table, rows, steps = places
    first, true = table.first_steps(rows, steps), table.objects_at(rows, steps)
    image, first = as_another_camera(first, generator)
    guess, reading = reader.read(image, first, bfloat16=bfloat16)
    size, known = table.size[rows], table.objects_known[rows, steps]
    used = torch.arange(MAX_OBJECTS) < torch.tensor(reader.config.num_objects)[first.task][:, None]
    used &= known
    there = true.present * known
    return _error(reading, true, size, used, there) + _GUESS_WEIGHT * _error(
        guess, true, size, used, there
    )


def _error(
    reading: Reading,
    true: ObjectPoses,
    size: Tensor,
    used: Bool[Tensor, "batch objects"],
    there: Float32[Tensor, "batch objects"],
) -> Float32[Tensor, ""]:
    """Errors of objects that are `there`, and of the presence of the slots that are `used`."""
    predicted = reading.objects
    position = functional.smooth_l1_loss(
        predicted.position_m / _UNIT_M, true.position_m / _UNIT_M, beta=0.1, reduction="none"
    ).sum(-1)
    axes = (predicted.axes - true.axes).square().sum((-1, -2))
    presence = functional.binary_cross_entropy(
        predicted.present.clamp(1e-4, 1 - 1e-4), true.present, reduction="none"
    )
    # Of a Gaussian on both axes of the table; the position is not trained by it.
    lateral_m = (predicted.position_m - true.position_m)[..., :2].detach().square().sum(-1)
    surprise = 2 * reading.sd_m.log() + lateral_m / (2 * reading.sd_m.square())
    # Squared: of an unclear size the mean is wanted, not the usual size, which most objects have.
    grown = ((reading.size.log() - size.log()) / _UNIT_LOG).square().sum(-1)
    each = position + axes + _SD_WEIGHT * surprise + _SIZE_WEIGHT * grown
    return (each * there).sum() / there.sum().clamp_min(1.0) + 0.3 * (
        presence * used
    ).sum() / used.sum().clamp_min(1)


@torch.no_grad()
def read_step(reader: StartReader, table: SceneTable, step: int) -> Reading:
    """What the reader makes of one step of every episode."""
    parts: list[Reading] = [
        reader(table.first_steps(rows, torch.full_like(rows, step)))
        for rows in torch.split(torch.arange(len(table)), _BATCH_OF_READING)
    ]
    return combined(parts, torch.cat)


def reader_errors(reader: StartReader, table: SceneTable, step: int) -> dict[str, ReaderError]:
    """Errors by task at one step of held-out episodes; tasks without objects are omitted."""
    predicted, errors = read_step(reader, table, step).objects, {}
    rows = torch.arange(len(table))
    true = table.objects_at(rows, step)
    for index, task in enumerate(reader.config.tasks):
        of_task = table.task == index
        known = table.objects_known[:, step] & of_task[:, None]
        there = (true.present > 0) & known
        if not there.any():
            continue
        off_mm = 1e3 * (predicted.position_m - true.position_m)[there]
        lateral = off_mm[:, :2].norm(dim=-1)
        cosine = functional.normalize(predicted.axes[there][:, 0], dim=-1) * true.axes[there][:, 0]
        used = (torch.arange(MAX_OBJECTS) < reader.config.num_objects[index]) & known
        right = (predicted.present > 0.5) == (true.present > 0)
        errors[task] = ReaderError(
            lateral_mm=float(lateral.median()),
            lateral_90_mm=float(lateral.quantile(0.9)),
            height_mm=float(off_mm[:, 2].abs().median()),
            axis_deg=float(torch.rad2deg(cosine.sum(-1).clamp(-1, 1).acos()).median()),
            presence=float(right[used].float().mean()),
        )
    return errors
