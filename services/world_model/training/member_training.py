"""Training of a state model's members: start readers on single steps, cores on whole episodes.

Readers are given images as other cameras take them; cores learn object motion and touch.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, Int64
from torch import Tensor, nn
from torch.nn import functional

from dextouch.command_line import ProgressLines
from dextouch.errors import InvalidInputError
from dextouch.images import decode_jpeg, encode_jpeg
from dextouch.schemas import MAX_OBJECTS
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from services.networks import optimizer
from services.world_model.dynamics.core import NUM_PADS, RecurrentCore, SceneStart, own_features
from services.world_model.dynamics.features import (
    STEPS_PER_LATENT,
    Commands,
    DynamicsConfig,
    ObjectPoses,
    TouchCodec,
)
from services.world_model.dynamics.model import by_pad
from services.world_model.dynamics.start_reader import FirstStep, Reading, StartReader
from services.world_model.dynamics.tensor_trees import Part, chosen, combined, mapped
from services.world_model.rendering.renderer import uses_bfloat16
from services.world_model.settings import CoreSettings, ReaderSettings
from services.world_model.training.scene_table import MEASURED_ERROR_M, SceneTable

# Metres that count as one in the errors of positions.
_UNIT_M = 0.05
_BATCH_OF_READING = 128
_WEIGHT_DECAY = 1e-3
_SD_WEIGHT = 0.02
_SIZE_WEIGHT, _UNIT_LOG = 0.3, 0.1
# Of the first guess, which the correction starts from.
_GUESS_WEIGHT = 0.5
# Standard deviations of the logarithm of gain, of each channel's gain, of contrast and of gamma.
_GAIN, _TINT, _CONTRAST, _GAMMA = 0.15, 0.08, 0.15, 0.15
_MOST_NOISE = 0.03
# Shifts of the image, of which the intrinsics know all but a remainder (standard deviation).
_MOST_SHIFT_PX, _UNKNOWN_SHIFT_PX = 1.5, 0.15
_JPEG_SHARE, _JPEG_QUALITY = 0.2, (25, 95)
_PLAIN_SHARE = 0.15
_WARMUP_STEPS = 100
_FIT_EPISODES = 1000
# Largest standard deviation of the logarithm of a size.
_SIZE_SD = 0.06
# Weight of the outcome as predicted at every latent step, relative to that at the last.
_EARLY_SUCCESS = 0.2
# Factor by which hands are held still more often at later starts, where fewer scenes allow it.
_LATER_HELD = 2.5
# Objects that moved less than this in the previous latent step count as settled.
_SETTLED_M = 1e-3
# Cores are trained from the first step and from every so many steps after it.
_START_STRIDE = 8
_TAXEL_SHARE = 4
# Chosen: some examples have measured actions, so that rollouts of these are known, too.
_MEASURED_SHARE = 0.15
Network = TypeVar("Network", bound=nn.Module)


def train_averaged(
    network: Network,
    loss: Callable[[], Tensor],
    settings: ReaderSettings | CoreSettings,
    *,
    weight_decay: float,
    title: str = "",
) -> Network:
    """Train a network in place on fresh batches of `loss`; returns its moving average.

    With a `title`, progress is shown.
    """
    options = optimizer.OptimizerOptions(
        settings.learning_rate,
        weight_decay,
        warmup_steps=_WARMUP_STEPS,
        schedule=lambda share: 0.01 + 0.99 * optimizer.half_cosine(share),
    )
    budget = optimizer.Budget(max_steps=settings.num_steps)
    lines = ProgressLines(title, has_bar=False)
    averaged = copy.deepcopy(network)
    for value in optimizer.OptimizerLoop(network, options, budget).run(loss):
        # Begins with a longer memory than that of a first update.
        weights = averaged.parameters(), network.parameters()
        optimizer.update_average(*weights, decay=settings.ema_decay, num_updates=budget.step)
        if title:
            lines.show(f"step {budget.step}  loss {value:.4f}")
    return averaged.eval()


def train_reader(
    table: SceneTable,
    config: DynamicsConfig,
    settings: ReaderSettings,
    *,
    seed: int,
    title: str = "",
    initial: StartReader | None = None,
) -> StartReader:
    """Train a reader, or `initial`, on single steps of labelled episodes, first and later ones."""
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        reader = initial or StartReader(config)
    _fit_heights(reader, table, config)
    later = [step for step in table.image_steps if step % 4 == 0 and step > 0]
    known = torch.nonzero(table.labelled)[:, 0]
    # Steps at which the pose of an object is known; all of tasks without objects.
    counts = torch.tensor(config.num_objects)[table.task]
    is_slot = torch.arange(MAX_OBJECTS) < counts[:, None]
    is_known = (table.objects_known & is_slot[:, None]).any(-1) | (counts == 0)[:, None]
    # Later steps of each episode, in their order; of further ones nothing is known, they have no
    # image or lie behind its end.
    places = [table.image_steps.index(step) for step in later]
    reached = (torch.tensor(later) < table.length[:, None]) & table.shown[:, places]
    reached &= is_known[:, later]
    counts = reached.sum(1)
    order = torch.argsort(~reached, dim=1, stable=True)
    bfloat16 = uses_bfloat16(setting=settings.bfloat16)

    def loss() -> Tensor:
        rows = table.drawn(known, settings.batch, generator)
        drawn = torch.randint(len(later), rows.shape, generator=generator)
        amid = torch.tensor(later)[order[rows, drawn % counts[rows].clamp_min(1)]]
        is_first = torch.rand(rows.shape, generator=generator) < settings.first_fraction
        is_first &= is_known[rows, 0]
        steps = torch.where(is_first | (counts[rows] == 0), 0, amid)
        first, true = table.first_steps(rows, steps), table.objects_at(rows, steps)
        image, first = as_another_camera(first, generator)
        guess, reading = reader.read(image, first, bfloat16=bfloat16)
        is_posed = table.objects_known[rows, steps]
        count = torch.tensor(config.num_objects)[first.task]
        used = (torch.arange(MAX_OBJECTS) < count[:, None]) & is_posed
        about = (true, table.size[rows], used, true.present * is_posed)
        return _error(reading, *about) + _GUESS_WEIGHT * _error(guess, *about)

    return train_averaged(reader, loss, settings, weight_decay=_WEIGHT_DECAY, title=title)


def _fit_heights(reader: StartReader, table: SceneTable, config: DynamicsConfig) -> None:
    """Fit resting heights: medians over the first steps of each task's episodes."""
    for task, count in enumerate(config.num_objects):
        for slot in range(count):
            first = table.objects.position_m[:, 0, slot, 2]
            there = (table.task == task) & (table.objects.present[:, 0, slot] > 0) & table.labelled
            there &= table.objects_known[:, 0, slot]
            if there.any():
                reader.height_mean[task, slot] = first[there].median()


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


def reader_errors(reader: StartReader, table: SceneTable) -> dict[str, float]:
    """Median and 90 % quantile of errors (mm) over the table at first steps, by task."""
    predicted, errors = read_step(reader, table, 0).objects, dict[str, float]()
    true = table.objects_at(torch.arange(len(table)), 0)
    for index, task in enumerate(reader.config.tasks):
        known = table.objects_known[:, 0] & (table.task == index)[:, None]
        there = (true.present > 0) & known
        if there.any():
            off_mm = 1e3 * (predicted.position_m - true.position_m)[there]
            lateral = off_mm[:, :2].norm(dim=-1)
            errors[f"start_lateral_mm_{task}"] = float(lateral.median())
            errors[f"start_lateral_90_mm_{task}"] = float(lateral.quantile(0.9))
    return errors


def as_another_camera(
    first: FirstStep, generator: torch.Generator
) -> tuple[Float32[Tensor, "batch 3 px px"], FirstStep]:
    """Images (0 … 1) as other cameras might take them, but for a share, and their intrinsics."""
    count, px = len(first.image), first.image.shape[1]

    def normal(*shape: int) -> Tensor:
        return torch.randn((count, *shape), generator=generator)

    def uniform(*shape: int) -> Tensor:
        return torch.rand((count, *shape), generator=generator)

    plain = uniform() < _PLAIN_SHARE
    original = first.image.permute(0, 3, 1, 2).float() / 255
    shift_px = (2 * uniform(2) - 1) * _MOST_SHIFT_PX
    image = _shifted(original, shift_px)
    image = image * (_GAIN * normal(1, 1, 1) + _TINT * normal(3, 1, 1)).exp()
    mean = image.mean((1, 2, 3), keepdim=True)
    image = mean + (image - mean) * (_CONTRAST * normal(1, 1, 1)).exp()
    image = image.clamp(0.0, 1.0).pow((_GAMMA * normal(1, 1, 1)).exp())
    image = torch.lerp(image, _blurred(image), (2 * uniform(1, 1, 1) - 1).clamp_min(0.0))
    image = image + normal(3, px, px) * _MOST_NOISE * uniform(1, 1, 1).square()
    image = _compressed(image.clamp(0.0, 1.0), uniform(2).numpy())
    K = first.K_head.clone()
    K[:, :2, 2] += torch.where(plain[:, None], 0.0, shift_px + _UNKNOWN_SHIFT_PX * normal(2))
    return torch.where(plain[:, None, None, None], original, image), replace(first, K_head=K)


def _shifted(
    image: Float32[Tensor, "batch 3 px px"], shift_px: Float32[Tensor, "batch 2"]
) -> Float32[Tensor, "batch 3 px px"]:
    """Content moved right and down, with repeated borders."""
    count, px = len(image), image.shape[-1]
    affine = torch.eye(2, 3).repeat(count, 1, 1)
    affine[:, :, 2] = -2 * shift_px / px
    grid = functional.affine_grid(affine, list(image.shape), align_corners=False)
    return functional.grid_sample(image, grid, padding_mode="border", align_corners=False)


def _blurred(image: Float32[Tensor, "batch 3 px px"]) -> Float32[Tensor, "batch 3 px px"]:
    weights = torch.tensor([0.25, 0.5, 0.25])
    kernel = (weights[:, None] * weights).expand(3, 1, 3, 3)
    return functional.conv2d(
        functional.pad(image, (1, 1, 1, 1), mode="replicate"), kernel, groups=3
    )


def _compressed(image: Float32[Tensor, "batch 3 px px"], draw: np.ndarray) -> Tensor:
    low, high = _JPEG_QUALITY
    for index in np.flatnonzero(draw[:, 0] < _JPEG_SHARE):
        pixels = (image[index].permute(1, 2, 0) * 255).round().byte().numpy()
        quality = int(low + (high - low) * draw[index, 1])
        decoded = decode_jpeg(encode_jpeg(pixels, quality=quality)).copy()
        image[index] = torch.from_numpy(decoded).permute(2, 0, 1).float() / 255
    return image


@dataclass(frozen=True)
class CoreData:
    """Training data of cores: episodes, touch latents and a reader's outputs.

    Cores start from true poses with noise, but from `readings` of their start step where objects
    are not labelled or not known, or everywhere if `starts_read`.
    """

    table: SceneTable
    touch: Float16[Tensor, "episodes steps 2 channels"]
    readings: Mapping[int, Reading]
    starts_read: bool = False


@dataclass(frozen=True)
class _Batch:
    rows: Int64[Tensor, " batch"]
    start_step: int
    start: SceneStart
    commands: Commands
    is_held: Bool[Tensor, " batch"]


def train_core(
    data: CoreData,
    config: DynamicsConfig,
    settings: CoreSettings,
    *,
    seed: int,
    title: str = "",
    initial: RecurrentCore | None = None,
) -> RecurrentCore:
    """Train a core, or what of `initial` requires gradients, on scenes from any start step."""
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        core = initial or RecurrentCore(config)
        if core.human is not None and not bool(data.table.human.any()):
            # Weights that no example reaches would decay.
            core.human.requires_grad_(requires_grad=False)
        describe(core, data.table, widens=initial is not None)

        def loss() -> Tensor:
            return core_loss(core, data, _draw(data, settings, generator, rng), settings)

        decay = settings.weight_decay
        return train_averaged(core, loss, settings, weight_decay=decay, title=title)


@torch.no_grad()
def describe(core: RecurrentCore, table: SceneTable, *, widens: bool = False) -> None:
    """Set a core's objects of every task, and the range of hands, or with `widens` widen it."""
    # Tasks without episodes keep what the core knows of them.
    seen = torch.bincount(table.task, minlength=len(core.boxes_m)) > 0
    core.boxes_m[seen] = table.boxes_m[seen]
    core.movable[seen] = table.movable()[seen]
    rows = torch.arange(0, len(table), max(1, len(table) // _FIT_EPISODES))
    commands = table.commands(rows, 0, torch.zeros(len(rows), dtype=torch.bool))
    wrist_m = commands.points_m[:, :, -1, :, 0]
    own = own_features(commands, torch.cat([wrist_m[:, :1], wrist_m], dim=1)).flatten(0, 2)
    lowest, highest = own.amin(0), own.amax(0)
    core.lowest.copy_(torch.minimum(core.lowest, lowest) if widens else lowest)
    core.highest.copy_(torch.maximum(core.highest, highest) if widens else highest)


def start_steps(table: SceneTable) -> list[int]:
    """Steps with an image from which cores are trained, up to the last possible latent step."""
    last = table.num_steps - 1 - STEPS_PER_LATENT
    starts = {*range(0, last, _START_STRIDE), last}
    return [step for step in table.image_steps if step in starts]


def _later_start(later: list[int], table: SceneTable, rng: np.random.Generator) -> int:
    """Random start, rarer near the end, which teaches little, and where few episodes have one."""
    remaining = np.sqrt([table.num_steps - 1 - step for step in later])
    weight = remaining * [len(table.starts_at(step)) for step in later]
    return int(rng.choice(later, p=weight / weight.sum()))


def _draw(
    data: CoreData, settings: CoreSettings, generator: torch.Generator, rng: np.random.Generator
) -> _Batch:
    table = data.table
    is_first = rng.random() < settings.first_fraction
    later = [step for step in start_steps(table) if step > 0 and len(table.starts_at(step))]
    starts_at_first = len(table.starts_at(0)) > 0
    if not (later or starts_at_first):
        raise InvalidInputError(
            "training: no take has a step with an image, measured actions and four more steps "
            "behind it, which cores start from; align the takes without the gap at their start"
        )
    is_first = starts_at_first and (is_first or not later)
    start_step = 0 if is_first else _later_start(later, table, rng)
    able = table.starts_at(start_step)
    rows = table.drawn(able, settings.batch, generator)

    def chance(fraction: float) -> Bool[Tensor, " batch"]:
        return torch.rand(len(rows), generator=generator) < fraction

    measured = chance(_MEASURED_SHARE) | ~table.commanded[rows]
    commands = table.commands(rows, start_step, measured)
    held = chance(settings.held_fraction * (1 if start_step == 0 else _LATER_HELD))
    held &= _is_settled(table, rows, start_step) & table.labelled[rows]
    start = _read_start(data, rows, start_step, settings, generator)
    scene = SceneStart(
        **vars(start),
        touch=data.touch[rows, start_step].float(),
        pads_kpa=table.pads_kpa[rows, start_step],
        task=table.task[rows],
        commanded=(~measured).float(),
        instruction=table.instruction[rows],
    )
    return _Batch(rows, start_step, scene, _held_still(commands, held), held)


def _is_settled(table: SceneTable, rows: Tensor, start_step: int) -> Bool[Tensor, " batch"]:
    """Entries without contact and object motion: holding still, nothing would change."""
    free = ~table.in_contact[rows, start_step].any(-1)
    before = max(0, start_step - STEPS_PER_LATENT)
    position_m = table.objects.position_m
    moved_m = (position_m[rows, start_step] - position_m[rows, before]).norm(dim=-1).amax(-1)
    error_m = torch.where(table.measured_objects[rows], MEASURED_ERROR_M, 0.0)
    known = table.knows_all(start_step)[rows] & table.knows_all(before)[rows]
    return free & known & (moved_m < _SETTLED_M + error_m)


def _read_start(
    data: CoreData,
    rows: Tensor,
    start_step: int,
    settings: CoreSettings,
    generator: torch.Generator,
) -> Reading:
    """True objects with noise, or a reader's where they are unknown or it shall be so.

    Poses from touch are those of takes that succeeded: where a task has some, all of its episodes
    start from what the reader sees, or starts would tell the outcome.
    """
    true = data.table.objects_at(rows, start_step)
    sd_m = settings.pose_noise_m * torch.rand(true.present.shape, generator=generator).square()
    shift = torch.randn(true.position_m.shape, generator=generator) * sd_m[..., None]
    shift[..., 2] *= 0.3
    turn = torch.randn(true.axes.shape, generator=generator) * sd_m[..., None, None] * 5.0
    # Sizes have the noise of a reader, too.
    size, normal = data.table.size[rows], torch.randn
    size_sd = _SIZE_SD * torch.rand((len(rows), 1, 1), generator=generator)
    size = size * (size_sd * normal(size.shape, generator=generator)).exp()
    noisy = Reading(
        ObjectPoses(true.position_m + shift, true.axes + turn, true.present),
        torch.hypot(sd_m, data.table.placed_sd_m[rows]),
        size,
    )
    known = data.table.labelled[rows] & data.table.knows_all(start_step)[rows]
    known &= ~data.table.touched[rows] & (not data.starts_read)
    if bool(known.all()):
        return noisy
    read: Reading = mapped(data.readings[start_step], lambda values: values[rows])
    return chosen(known, noisy, read)


def _held_still(part: Part, held: Bool[Tensor, " batch"]) -> Part:
    """Commands or poses that stay those of the first latent step in the rows that are held."""
    return chosen(held, mapped(part, lambda values: values[:, :1].expand_as(values)), part)


def core_loss(
    core: RecurrentCore, data: CoreData, batch: _Batch, settings: CoreSettings
) -> Float32[Tensor, ""]:
    """Weighted sum of the errors in objects, touch, contact and final success.

    Of hands held still without contact, the targets are no motion and the same touch. A change of
    it needs a new `CORE_VERSION` (`state_trainer`).
    """
    commands, start = batch.commands, batch.start
    table, rows = data.table, batch.rows
    human = table.human[rows].float()
    future, _ = core(commands, start, core.first_state(start, commands[:1], human), human)
    within = table.within(rows, batch.start_step)
    weights = settings.weights
    success = weights.success * _success_error(
        future.success, table.success[rows] * ~batch.is_held, within
    )
    if not (weights.objects or weights.touch or weights.contact or weights.taxels):
        return success
    counted = table.measured_within(rows, batch.start_step)
    latents = torch.arange(batch.start_step, table.num_steps, STEPS_PER_LATENT)
    true = mapped(table.objects, lambda values: values[rows][:, latents])
    true = replace(_held_still(true, batch.is_held), present=true.present)
    known = start.objects.present[:, None] * table.labelled[rows, None, None]
    known = known * table.objects_known[rows][:, latents]
    known[:, 1:] *= counted[..., None]
    steps = table.steps_after(batch.start_step)
    moves = ~batch.is_held
    touch = data.touch[rows][:, steps].float()
    touch = chosen(moves, touch, start.touch[:, None, None].expand_as(touch))
    contact = table.in_contact[rows][:, steps] & moves.view(-1, 1, 1, 1)
    # Part of the batch suffices: each of its rows has thousands of taxels.
    few = slice(0, -(-len(rows) // _TAXEL_SHARE))
    pressed = table.tactile_kpa[rows[few]][:, steps] >= CONTACT_THRESHOLD_KPA
    pressed &= moves[few].view(-1, 1, 1, 1, 1)
    contact_error = functional.binary_cross_entropy_with_logits(
        future.contact[:, 1:], contact.float(), reduction="none"
    )
    taxel_error = functional.binary_cross_entropy_with_logits(
        core.taxels(future.pattern[few, 1:]), pressed.float(), reduction="none"
    )
    felt, taxels = table.felt[rows][:, steps], table.measured_taxels[rows]
    pads = torch.from_numpy(by_pad(taxels.float().numpy(), np.max, core.config.tactile_layout) > 0)[
        :, None, None
    ]
    pads = pads & felt.repeat_interleave(NUM_PADS // 2, dim=-1)
    taxels = taxels[few, None, None] & felt[few, ..., None]
    touch_error = (future.touch[:, 1:] - touch).square().sum(-1)
    return (
        success
        + weights.objects * _object_error(future.objects, true, known)
        + weights.touch * _mean_within(touch_error, counted, felt)
        + weights.contact * _mean_within(contact_error, counted, pads)
        + weights.taxels * _mean_within(taxel_error, counted[few], taxels)
    )


def _mean_within(
    each: Float32[Tensor, "batch latents ..."],
    within: Bool[Tensor, "batch latents"],
    measured: Bool[Tensor, "batch latents ..."],
) -> Float32[Tensor, ""]:
    """Mean over what was measured at the latent steps that count."""
    if bool(measured.all()):
        by_latent = each.flatten(2).mean(-1)
        return (by_latent * within).sum() / within.sum().clamp_min(1)
    counted = measured & within.view(*within.shape, *[1] * (each.ndim - 2))
    return (each * counted).sum() / counted.sum().clamp_min(1)


def _success_error(
    log_odds: Float32[Tensor, "batch latents_and_start"],
    success: Float32[Tensor, " batch"],
    within: Bool[Tensor, "batch latents"],
) -> Float32[Tensor, ""]:
    """Cross entropy of the outcome at an episode's last latent step and, with less weight, all."""
    goal = success[:, None].expand_as(log_odds)
    each = functional.binary_cross_entropy_with_logits(log_odds, goal, reduction="none")
    counted = torch.cat([torch.ones_like(within[:, :1]), within], dim=1)[:, -each.shape[1] :]
    last = each.gather(1, counted.sum(1, keepdim=True) - 1)
    return last.mean() + _EARLY_SUCCESS * (each * counted).sum() / counted.sum()


def _object_error(
    predicted: ObjectPoses, true: ObjectPoses, known: Float32[Tensor, "batch latents objects"]
) -> Float32[Tensor, ""]:
    """Errors of positions (twice) and axes of objects present now, known, and seen at the start."""
    weight = true.present * (known > 0.5)
    position = functional.smooth_l1_loss(
        predicted.position_m / _UNIT_M, true.position_m / _UNIT_M, beta=0.2, reduction="none"
    ).sum(-1)
    axes = (predicted.axes - true.axes).square().sum((-1, -2))
    return ((2.0 * position + axes) * weight).sum() / weight.sum().clamp_min(1.0)


@torch.no_grad()
def touch_latents(codec: TouchCodec, table: SceneTable) -> Tensor:
    """Latents of all touch of a table, as float16 to save memory."""
    return torch.stack([codec.encode(touch.float()).half() for touch in table.tactile_kpa])
