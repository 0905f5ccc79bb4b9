"""Training of behaviour cloning on successful episodes, with an optional early checkpoint."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8

from dextouch.episodes import (
    TRUE_ORIGINS,
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    Split,
    data_hash,
    needs,
    select_episodes,
    split_by_scene,
)
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import WRIST_LEFT, WRIST_RIGHT, AnchorPoses
from dextouch.schemas import CHUNK_STEPS, Origin
from services.evaluation.matched_starts import start_digest
from services.evaluation.policies.behaviour_cloning import (
    KIND,
    NUM_POSE_FEATURES,
    SLOT_STEPS,
    CloningBatch,
    CloningInput,
    CloningNetwork,
    CloningShape,
    cloning_state,
    half_size,
    in_world,
    scaled_images,
)
from services.evaluation.settings import CloningSettings
from services.evaluation.trained_networks import (
    Checkpoint,
    CheckpointMetadata,
    instructions_of,
    network_tensors,
    optimized,
)
from services.networks.training_settings import USUAL_IMAGE_PX

# Training uses every such step; an evaluation with chunks of 16 decides at every second of them.
DECISION_STRIDE: Final = SLOT_STEPS
# What an episode of a cloned policy must have.
IMITATED: Final = (
    needs.EVERY_PART,
    needs.WHOLE,
    needs.OUTCOME,
    needs.SUCCESS,
    needs.image_every(DECISION_STRIDE),
)
# Batch size of the held-out evaluation.
_TESTED_AT_ONCE = 128
MOMENTS_AN_EPISODE = 3
# Chunks that vary less (in squared deviations of their principal axes) teach nothing.
MIN_VARIANCE = 1e-9
# Augmentation, chosen: noise and brightness of images (standard deviations, of 0 … 1), and noise of
# poses relative to their spread, so that the policy meets poses beside the demonstrated ones.
_IMAGE_NOISE, _BRIGHTNESS, _POSE_NOISE = 0.02, 0.06, 0.2
# Large weights stored as float16 to keep files below a megabyte.
_KEPT_AS_HALF = ("codec.basis", "head.0.weight", "head.2.weight")


@dataclass(frozen=True)
class Moment:
    """Image and touch at one step."""

    image: UInt8[np.ndarray, "h w 3"]
    tactile_kpa: Float32[np.ndarray, "2 taxels"]


@dataclass(frozen=True)
class CloningEpisode:
    """One robot episode: measured and commanded actions at every step, observations at some.

    `commanded` are the measured ones where the episode has no commands. Both actions are relative
    to the measured poses of step 0, which are `anchor`. `moments` maps steps to observations and
    includes step 0. `start_digest` is that of the first observation as recorded.
    """

    episode_id: str
    task: str
    instruction: str
    scene: str
    success: bool
    anchor: AnchorPoses
    moments: Mapping[int, Moment]
    measured: Float64[np.ndarray, "steps 67"]
    commanded: Float64[np.ndarray, "steps 67"]
    start_digest: str
    content_sha256: str
    interpolated: Bool[np.ndarray, " steps"] | None = None

    @property
    def num_steps(self) -> int:
        """Steps of the model grid, including the first one."""
        return len(self.measured)

    def decisions(self) -> list[int]:
        """Decision steps that are followed by a whole chunk of which no step is interpolated."""
        steps = range(0, self.num_steps - CHUNK_STEPS, DECISION_STRIDE)
        if self.interpolated is None:
            return list(steps)
        return [s for s in steps if not self.interpolated[s : s + CHUNK_STEPS + 1].any()]


def read_cloning_episode(
    reader: EpisodeReader, *, image_px: int = USUAL_IMAGE_PX
) -> CloningEpisode:
    """Read one robot episode that has what is `IMITATED`.

    Only images at decision steps are decoded, and the middle square of larger ones is scaled to
    `image_px`. Raises InvalidInputError if the outcome is unknown.
    """
    grid, about = EpisodeGrid(reader, image_px), reader.attributes
    steps = range(0, len(grid), DECISION_STRIDE)
    touch_kpa, _ = grid.touch()
    return CloningEpisode(
        about.episode_id,
        about.task,
        about.instruction,
        grid.scene,
        grid.success,
        grid.anchor,
        {
            step: Moment(image, touch_kpa[step].copy())
            for step, image in zip(steps, grid.images(steps), strict=True)
        },
        grid.measured,
        grid.sent,
        start_digest(EpisodeGrid(reader).images([0])[0], touch_kpa[0]),
        grid.content_sha256,
        grid.interpolated,
    )


def read_cloning_episodes(
    *stores: EpisodeStore,
    tasks: Sequence[str] = (),
    splits: Collection[Split] = (),
    image_px: int = USUAL_IMAGE_PX,
    imagined: bool = False,
) -> list[CloningEpisode]:
    """Read the successful robot episodes of some stores, store by store in the order of ids.

    With `imagined`, imagined episodes are read instead of true ones. Raises as `select_episodes`.
    """
    origins: Collection[Origin] = ("imagined",) if imagined else TRUE_ORIGINS
    readers = select_episodes(
        stores, domain="robot", tasks=tasks, splits=splits, origins=origins, needs=IMITATED
    )
    return [read_cloning_episode(reader, image_px=image_px) for reader in readers]


@dataclass(frozen=True)
class Decisions:
    """Training samples at decision steps, with the chunks (in the world) that were sent next.

    Images are bytes: `firsts` [m, h, w, 3], one per episode; `newest` [k, h/2, w/2, 3]. `episode`
    and `frame` index them for sample n. Samples of an episode are contiguous: `begins` [m + 1].
    """

    firsts: torch.Tensor
    newest: torch.Tensor
    episode: torch.Tensor
    frame: torch.Tensor
    begins: torch.Tensor
    state: torch.Tensor
    task: torch.Tensor
    slot: torch.Tensor
    chunks: torch.Tensor

    def __len__(self) -> int:
        return len(self.chunks)

    def batch(self, index: torch.Tensor) -> CloningBatch:
        """Inputs of some samples; first images are deduplicated."""
        episodes, rollout = torch.unique(self.episode[index], return_inverse=True)
        return CloningBatch(
            scaled_images(self.firsts[episodes]),
            rollout,
            scaled_images(self.newest[self.frame[index]]),
            self.state[index],
            self.task[index],
            self.slot[index],
        )

    def drawn(self, num_moments: int, generator: torch.Generator) -> torch.Tensor:
        """Random samples, three per episode: encoding first images takes most of the time."""
        num_episodes = -(-num_moments // MOMENTS_AN_EPISODE)
        episodes = torch.randint(len(self.firsts), (num_episodes,), generator=generator)
        shares = torch.rand((num_episodes, MOMENTS_AN_EPISODE), generator=generator)
        begins, ends = self.begins[episodes, None], self.begins[episodes + 1, None]
        return (begins + (shares * (ends - begins)).long()).flatten()[:num_moments]


def decisions_of(episodes: Sequence[CloningEpisode], shape: CloningShape) -> Decisions:
    """Samples at every eighth step of successful episodes, once as measured and once as imagined.

    An imagined world measures no joints and returns the given actions, so each sample is also
    trained on with the commanded pose in place of the measured one. Raises InvalidInputError if no
    successful episode is long enough, or image sizes differ.
    """
    demonstrations = [item for item in episodes if item.success and item.decisions()]
    if not demonstrations:
        raise InvalidInputError("behaviour cloning: no successful demonstration to imitate")
    sizes = sorted({item.moments[0].image.shape for item in demonstrations})
    if len(sizes) > 1:
        raise InvalidInputError(
            f"behaviour cloning: got images of {sizes[0]} and of {sizes[1]}, expected one size"
        )
    inputs: list[CloningInput] = []
    chunks: list[np.ndarray] = []
    newest: list[np.ndarray] = []
    frame: list[int] = []
    begins = [0]
    for item in demonstrations:
        commanded = in_world(item.commanded, item.anchor)
        for step in item.decisions():
            moment = item.moments[step]
            newest.append(half_size(moment.image))
            for measured in (True, False) if step else (True,):
                reached = (item.measured if measured else item.commanded)[step]
                chunks.append(commanded[step + 1 : step + 1 + CHUNK_STEPS])
                frame.append(len(newest) - 1)
                inputs.append(
                    CloningInput(
                        moment.tactile_kpa, item.anchor, reached, measured, step, item.task
                    )
                )
        begins.append(len(inputs))
    counts = torch.tensor(begins).diff()
    return Decisions(
        torch.from_numpy(np.stack([item.moments[0].image for item in demonstrations])),
        torch.from_numpy(np.stack(newest)),
        torch.arange(len(demonstrations)).repeat_interleave(counts),
        torch.tensor(frame),
        torch.tensor(begins),
        *cloning_state(inputs, shape),
        torch.tensor(np.stack(chunks), dtype=torch.float32),
    )


def train_cloned_policy(
    episodes: Sequence[CloningEpisode],
    settings: CloningSettings,
    *,
    command: str,
    early_at: float | None = None,
) -> tuple[Checkpoint, Checkpoint | None]:
    """The policy trained on successful episodes and, if requested, an early one.

    Failed episodes are skipped. The early policy is that after the share `early_at` of the
    training. Metadata hold the held-out error, and that of the mean chunk. Raises InvalidInputError
    for a task without a demonstration that is long enough and not held out.
    """
    torch.manual_seed(settings.seed)
    tasks = tuple(sorted({item.task for item in episodes}))
    shape = CloningShape(tasks=tasks, image_size_px=episodes[0].moments[0].image.shape[0])
    training, held_out = split_by_scene(episodes, held_out_share=settings.held_out_share)
    learned, tested = decisions_of(training, shape), decisions_of(held_out, shape)
    if absent := [task for at, task in enumerate(tasks) if not (learned.task == at).any()]:
        raise InvalidInputError(
            f"behaviour cloning: of {', '.join(absent)} no demonstration that is longer than "
            f"{CHUNK_STEPS} steps is left to train on; record more, or choose other --tasks"
        )
    network = CloningNetwork(shape)
    _fit_statistics(network, learned)

    def checkpoint(cpu_s: float, share: float) -> Checkpoint:
        metadata = CheckpointMetadata(
            kind=KIND,
            command=command,
            seed=settings.seed,
            data_hash=data_hash(
                (item.content_sha256 for item in episodes), image_px=shape.image_size_px
            ),
            tasks=tasks,
            training_episodes=tuple(item.episode_id for item in training),
            training_starts=tuple(sorted({item.start_digest for item in training})),
            settings={
                "shape": shape.model_dump(),
                "training": settings.model_dump(),
                "instructions": instructions_of((e.task, e.instruction) for e in episodes),
                "share_of_training": share,
            },
            metrics={
                "num_training_decisions": len(learned),
                "num_held_out_decisions": len(tested),
                "training_cpu_s": round(cpu_s, 1),
                **_errors(network, tested, tasks),
            },
        )
        return Checkpoint(metadata, network_tensors(network, halved=_KEPT_AS_HALF))

    wanted = network.codec.encode(learned.chunks, learned.task, learned.slot)
    variance = wanted.var(0).sum()
    if not variance > MIN_VARIANCE:
        raise InvalidInputError(
            f"behaviour cloning: the {len(learned.firsts)} demonstrations of {len(tasks)} tasks do "
            "not differ, expected several of each task; record more"
        )

    def loss(generator: torch.Generator) -> torch.Tensor:
        index = learned.drawn(settings.batch_size, generator)
        part = _disturbed(learned.batch(index), network, generator)
        return (network(part) - wanted[index]).square().sum(1).mean() / variance

    early: Checkpoint | None = None
    cpu_s = 0.0
    for used in optimized(network, loss, settings, title="policy"):
        cpu_s = used.cpu_s
        if early_at is not None and early is None and used.share() >= early_at:
            with used.paused():
                early = checkpoint(cpu_s, round(used.share(), 4))
    return checkpoint(cpu_s, 1.0), early


def _fit_statistics(network: CloningNetwork, learned: Decisions) -> None:
    with torch.no_grad():
        network.codec.fit(learned.chunks, learned.task, learned.slot)
        coefficients = network.codec.encode(learned.chunks, learned.task, learned.slot)
        network.coefficient_scale.copy_(coefficients.std(0).clamp_min(1e-3))
        poses = network.poses(learned.state)
        network.pose_mean.copy_(poses.mean(0))
        network.pose_scale.copy_(poses.std(0).clamp_min(1e-2))


def _disturbed(
    batch: CloningBatch, network: CloningNetwork, generator: torch.Generator
) -> CloningBatch:
    """Augment; the target stays where it is in the world, so that the policy learns to recover."""
    state = batch.state.clone()
    noise = torch.randn((len(state), NUM_POSE_FEATURES), generator=generator)
    network.poses(state).add_(noise * network.pose_scale * _POSE_NOISE)

    def spoilt(images: torch.Tensor) -> torch.Tensor:
        noise = torch.randn(images.shape, generator=generator) * _IMAGE_NOISE
        brightness = torch.randn((len(images), 1, 1, 1), generator=generator) * _BRIGHTNESS
        return images + noise + brightness

    return replace(batch, state=state, first=spoilt(batch.first), newest=spoilt(batch.newest))


def _errors(network: CloningNetwork, tested: Decisions, tasks: Sequence[str]) -> dict[str, float]:
    """Wrist error at the end of held-out chunks, and that of the mean chunk of task and slot."""
    columns = [*range(WRIST_LEFT.start, WRIST_LEFT.start + 3)]
    columns += [*range(WRIST_RIGHT.start, WRIST_RIGHT.start + 3)]
    found: dict[str, list[torch.Tensor]] = {"": [], "_of_mean_chunk": []}
    network.eval()
    with torch.no_grad():
        for index in torch.split(torch.arange(len(tested)), _TESTED_AT_ONCE):
            coefficients = network(tested.batch(index))
            for name, used in zip(
                found, (coefficients, torch.zeros_like(coefficients)), strict=True
            ):
                chunks = network.codec.decode(used, tested.task[index], tested.slot[index])
                difference = (chunks - tested.chunks[index])[:, -1, columns].reshape(-1, 2, 3)
                found[name].append(1e3 * difference.norm(dim=-1).mean(1))
    network.train()
    figures = {}
    for name, parts in found.items():
        errors_mm = torch.cat(parts)
        figures[f"wrist_error_mm{name}"] = round(float(errors_mm.mean()), 2)
        for number, task in enumerate(tasks):
            chosen = errors_mm[tested.task == number]
            if len(chosen):
                figures[f"wrist_error_mm{name}_{task}"] = round(float(chosen.mean()), 2)
    return figures
