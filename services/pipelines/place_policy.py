"""Policy of places: it sees where objects stand, and moves as in demonstrations of such places.

It looks once, by the start readers of a state model, and regresses the motion of a whole take.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float64

from dextouch.clients import PolicyStart
from dextouch.episodes import EpisodeGrid, EpisodeReader, EpisodeStore, data_hash, select_episodes
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, AnchorPoses
from dextouch.schemas import CHUNK_STEPS, Observation, Origin
from dextouch.serving import load_settings
from dextouch.streams import HEAD_CAMERA
from services.evaluation import command_line as evaluation
from services.evaluation.matched_starts import start_digest
from services.evaluation.policies.behaviour_cloning import action_weights, from_world, in_world
from services.evaluation.policies.cloning_training import IMITATED
from services.evaluation.settings import CloningSettings, TrainPolicySettings, command_line
from services.evaluation.trained_networks import Checkpoint, CheckpointMetadata
from services.networks.weight_files import load_strictly
from services.world_model.checkpoints import read_state_checkpoint
from services.world_model.dynamics.features import DynamicsConfig, hand_motion
from services.world_model.dynamics.model import first_steps, mean_poses
from services.world_model.dynamics.start_reader import StartReader
from services.world_model.dynamics.tensor_trees import stacked

KIND: Final = "place-policy"
_IMAGINED: Final[tuple[Origin, ...]] = ("imagined",)
_READER, _MOTION = "reader.", "motion."
# Demonstrations of a task below which its regression is refused.
LEAST_DEMONSTRATIONS: Final = 5
# Motions are combinations of at most this many principal ones; 48 suffice for chunks of the cloned
# policy, too.
_NUM_COMPONENTS: Final = 48
# Inputs that vary less in demonstrations say nothing (m). A turn of an object counts as the way of
# a point this far from its middle, about the half length of an object.
_LEAST_SD: Final = 1e-3
_AXIS_M: Final = 0.15
# Places are clipped to this many standard deviations: beyond them a trend is a guess.
_FARTHEST: Final = 3.0
# Chosen: a linear trend of this variance, with smooth deviations of variance 1 and a length of some
# standard deviations of all inputs together.
_TREND, _LENGTH = 3.0, 3.0
# Variances of noise that are tried, relative to that of the deviations.
_NOISES: Final = (1e-3, 1e-2, 1e-1)


@dataclass(frozen=True)
class Places:
    """What a motion depends on, in the world frame.

    `points_m` [n, 3 (objects + 2)] are the objects' positions and both wrists', `axes` [n, 6
    objects] the directions of the objects' z and x axes, shorter where they cannot be seen.
    """

    points_m: Float64[np.ndarray, "n points"]
    axes: Float64[np.ndarray, "n axes"]

    def inputs(self, *, turned: bool) -> Float64[np.ndarray, "n inputs"]:
        """Inputs of a regression, with the axes if `turned`."""
        parts = [self.points_m, _AXIS_M * self.axes] if turned else [self.points_m]
        return np.concatenate(parts, axis=1)


def read_places(
    readers: Sequence[StartReader],
    config: DynamicsConfig,
    task: str,
    observation: Observation,
    anchor: AnchorPoses,
    K_head: Float64[np.ndarray, "3 3"],
) -> Places:
    """Find the objects in the first step of an observation.

    Raises UnknownNameError without head camera or for an unknown task, InvalidInputError for an
    image of another size.
    """
    if task not in config.tasks:
        raise UnknownNameError("task of the place policy", task, list(config.tasks))
    if HEAD_CAMERA not in observation.images:
        raise UnknownNameError("camera", HEAD_CAMERA, list(observation.images))
    image, size = observation.images[HEAD_CAMERA][0], (config.image_px, config.image_px, 3)
    if image.shape != size:
        raise InvalidInputError(f"place policy: got an image {image.shape}, expected {size}")
    motion = hand_motion(observation.action_reached[:1], anchor)
    index = config.tasks.index(task)
    touch, layout = observation.tactile_kpa[0], config.tactile_layout
    first = first_steps([image], [K_head], [touch], [motion], [index], layout)
    with torch.no_grad():
        objects = mean_poses(stacked([reader(first).objects for reader in readers]))
    count = config.num_objects[index]
    positions = [objects.position_m[0, :count].numpy(), motion.points_m[0, :, 0]]
    return Places(
        np.concatenate(positions).astype(np.float64).reshape(1, -1),
        objects.axes[0, :count].double().numpy().reshape(1, -1),
    )


@dataclass(frozen=True)
class Motion:
    """Gaussian process regression (Rasmussen and Williams 2006, eq. 2.25) of whole motions.

    Inputs are standardized by `mean` and `scale`; those that do not vary have a scale of 0 and no
    effect. `components` [k, steps · 67] and `mean_motion` are in units of `action_weights`.
    """

    turned: bool
    mean: Float64[np.ndarray, " inputs"]
    scale: Float64[np.ndarray, " inputs"]
    known: Float64[np.ndarray, "n inputs"]
    weights: Float64[np.ndarray, "n k"]
    components: Float64[np.ndarray, "k numbers"]
    mean_motion: Float64[np.ndarray, " numbers"]

    @classmethod
    def fitted(cls, places: Places, motions: Float64[np.ndarray, "n steps 67"]) -> "Motion":
        """Fit motions with poses in the world to places.

        Whether axes of objects are inputs and how noisy motions are is what predicts each
        demonstration best from all others (the same, eq. 5.12).
        """
        flat = (motions * action_weights()).reshape(len(motions), -1)
        mean_motion = flat.mean(axis=0)
        left, sizes, components = np.linalg.svd(flat - mean_motion, full_matrices=False)
        kept = slice(None, _NUM_COMPONENTS)
        targets = (left * sizes)[:, kept]
        found: list[tuple[float, Motion]] = []
        for turned in (False, True):
            inputs = places.inputs(turned=turned)
            mean, sd = inputs.mean(axis=0), inputs.std(axis=0)
            scale = np.where(sd > _LEAST_SD, 1 / np.maximum(sd, _LEAST_SD), 0.0)
            known = _standardized(inputs, mean, scale)
            covariance = _covariance(known, known, scale)
            for noise in _NOISES:
                inverse = np.linalg.inv(covariance + noise * np.eye(len(known)))
                weights = inverse @ targets
                error = float(np.square(weights / np.diag(inverse)[:, None]).sum(axis=1).mean())
                of_all = cls(turned, mean, scale, known, weights, components[kept], mean_motion)
                found.append((error, of_all))
        return min(found, key=lambda pair: pair[0])[1]

    def at(self, places: Places) -> Float64[np.ndarray, "steps 67"]:
        """The motion at some place."""
        inputs = _standardized(places.inputs(turned=self.turned), self.mean, self.scale)
        share = _covariance(inputs, self.known, self.scale)[0] @ self.weights
        flat = self.mean_motion + share @ self.components
        return flat.reshape(-1, ACTION_DIM) / action_weights()

    def tensors(self) -> dict[str, torch.Tensor]:
        """The arrays as float32, components as float16."""
        halved = torch.from_numpy(self.components).half()
        names = ("mean", "scale", "known", "weights", "mean_motion")
        each = {name: torch.from_numpy(getattr(self, name)).float() for name in names}
        return {**each, "components": halved, "turned": torch.tensor([float(self.turned)])}

    @classmethod
    def from_tensors(cls, tensors: dict[str, torch.Tensor]) -> "Motion":
        """Inverse of `tensors`.

        Raises InvalidInputError for missing tensors, or shapes that do not fit together.
        """
        names = ("mean", "scale", "known", "weights", "components", "mean_motion")
        if set(tensors) == {*names, "turned"} and tensors["turned"].shape == (1,):
            arrays = {name: tensors[name].double().numpy() for name in names}
            n, inputs = arrays["known"].shape if arrays["known"].ndim == 2 else (0, 0)
            k, numbers = arrays["components"].shape if arrays["components"].ndim == 2 else (0, 0)
            shapes = [(inputs,), (inputs,), (n, inputs), (n, k), (k, numbers), (numbers,)]
            fits = [arrays[name].shape for name in names] == shapes and n > 0 and numbers > 0
            if fits and numbers % ACTION_DIM == 0:
                return cls(bool(tensors["turned"][0] > 0.5), **arrays)
        found = {name: list(tensor.shape) for name, tensor in tensors.items()}
        raise InvalidInputError(f"place policy: got tensors {found}, which are no motion")


def _standardized(inputs: np.ndarray, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return ((inputs - mean) * scale).clip(-_FARTHEST, _FARTHEST)


def _covariance(
    a: Float64[np.ndarray, "n inputs"],
    b: Float64[np.ndarray, "m inputs"],
    scale: Float64[np.ndarray, " inputs"],
) -> Float64[np.ndarray, "n m"]:
    count = max(1, int(np.count_nonzero(scale)))
    squares = np.square(a[:, None] - b[None]).sum(axis=-1)
    return _TREND * (a @ b.T) / count + np.exp(-squares / (2 * _LENGTH**2 * count))


class PlacePolicy:
    """Sends the motion of a whole take, in chunks of 16 actions.

    Raises InvalidInputError for weights that do not fit the configuration in the metadata.
    """

    # Images after the first one are of no use to it.
    uses_images = False

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.metadata = checkpoint.metadata
        settings = checkpoint.metadata.settings
        self._config = DynamicsConfig.model_validate(settings["reads"])
        self._readers = [StartReader(self._config).eval() for _ in range(settings["num_readers"])]
        networks = {f"{_READER}{index}.": one for index, one in enumerate(self._readers)}
        motions = {n: t for n, t in checkpoint.tensors.items() if n.startswith(_MOTION)}
        rest = {n: t for n, t in checkpoint.tensors.items() if n not in motions}
        load_strictly(networks, rest, where=f"checkpoint of {KIND}")
        self._motions = {task: _motion_of(task, motions) for task in self.tasks}
        self._start: PolicyStart | None = None
        self._plan: Float64[np.ndarray, "steps 67"] | None = None

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks it has demonstrations of."""
        return self.metadata.tasks

    def reset(self, start: PolicyStart) -> None:
        """Start a new rollout; raises UnknownNameError for a task without demonstrations."""
        if start.task not in self._motions:
            raise UnknownNameError("task of the place policy", start.task, list(self._motions))
        self._start, self._plan = start, None

    def act(self, observation: Observation) -> Float64[np.ndarray, "16 67"]:
        """The next 16 commanded actions, relative to the rollout's step 0; at the end, the last.

        Raises InvalidInputError before `reset`, and as `read_places`.
        """
        start = self._start
        if start is None:
            raise InvalidInputError("place policy: act before reset; call reset with the start")
        if self._plan is None:
            places = read_places(
                self._readers, self._config, start.task, observation, start.anchor, start.K_head
            )
            self._plan = from_world(self._motions[start.task].at(places), start.anchor)
        first = observation.first_step + len(observation) - 1
        steps = np.arange(first, first + CHUNK_STEPS).clip(max=len(self._plan) - 1)
        return self._plan[steps]


def _motion_of(task: str, tensors: dict[str, torch.Tensor]) -> Motion:
    # Names of tasks may have dots.
    named = [(name.rpartition("."), tensor) for name, tensor in tensors.items()]
    return Motion.from_tensors(
        {last: t for (first, _, last), t in named if first == _MOTION + task}
    )


@dataclass(frozen=True)
class Demonstration:
    """One successful take: what it starts from, and its commanded motion with poses in the world.

    `motion` [steps, 67] are the commands of the steps after the first; `start_digest` is that of
    the first observation as recorded.
    """

    grid: EpisodeGrid
    first: Observation
    motion: Float64[np.ndarray, "steps 67"]
    start_digest: str

    @classmethod
    def of(cls, reader: EpisodeReader, image_px: int) -> "Demonstration":
        """Read an episode that has what is `IMITATED`."""
        grid = EpisodeGrid(reader, image_px)
        first = Observation(
            first_step=0,
            images={HEAD_CAMERA: grid.images([0])},
            tactile_kpa=grid.touch()[0][:1].astype(np.float32),
            action_reached=grid.measured[:1],
            reached_is_measured=True,
        )
        recorded = EpisodeGrid(reader).images([0])[0]
        digest = start_digest(recorded, first.tactile_kpa[0])
        return cls(grid, first, in_world(grid.sent[1:], grid.anchor), digest)


def read_demonstrations(settings: TrainPolicySettings) -> list[Demonstration]:
    """The successful robot episodes of the stores, and those that were imagined.

    Raises NotFoundError and ConflictError as `select_episodes`.
    """
    chosen = partial(select_episodes, domain="robot", tasks=settings.tasks, needs=IMITATED)
    stores = [EpisodeStore(url) for url in settings.episodes]
    readers = list(chosen(stores, splits=settings.splits))
    if settings.imagined:
        readers += chosen([EpisodeStore(url) for url in settings.imagined], origins=_IMAGINED)
    return [Demonstration.of(reader, settings.image_px) for reader in readers]


def train_place_policy(
    demonstrations: Sequence[Demonstration], model: Path, *, command: str
) -> Checkpoint:
    """Fit the motions of every task; the start readers of the state model `model` find the objects.

    Raises InvalidInputError for too few takes of a task, and as `read_places`.
    """
    found = read_state_checkpoint(model)
    config, readers = found.metadata.dynamics, found.dynamics.readers()
    tensors: dict[str, torch.Tensor] = {}
    metrics: dict[str, float] = {}
    tasks = tuple(sorted({one.grid.task for one in demonstrations}))
    for task in tasks:
        own = [one for one in demonstrations if one.grid.task == task]
        if len(own) < LEAST_DEMONSTRATIONS:
            raise InvalidInputError(
                f"place policy: got {len(own)} successful takes of {task!r}, expected at least "
                f"{LEAST_DEMONSTRATIONS}; record more, or leave it out with --tasks"
            )
        each = [
            read_places(readers, config, task, one.first, one.grid.anchor, one.grid.K_head)
            for one in own
        ]
        places = Places(
            np.concatenate([one.points_m for one in each]),
            np.concatenate([one.axes for one in each]),
        )
        # Shorter takes stay at their end.
        steps = np.arange(max(len(one.motion) for one in own))
        motions = np.stack([one.motion[steps.clip(max=len(one.motion) - 1)] for one in own])
        motion = Motion.fitted(places, motions)
        tensors |= {f"{_MOTION}{task}.{name}": one for name, one in motion.tensors().items()}
        metrics[f"num_demonstrations_{task}"] = len(own)
    for index, reader in enumerate(readers):
        halves = {name: value.half() for name, value in reader.state_dict().items()}
        tensors |= {f"{_READER}{index}.{name}": value for name, value in halves.items()}
    metadata = CheckpointMetadata(
        kind=KIND,
        command=command,
        seed=0,
        data_hash=data_hash(
            (one.grid.content_sha256 for one in demonstrations), image_px=config.image_px
        ),
        tasks=tasks,
        training_episodes=tuple(one.grid.episode_id for one in demonstrations),
        training_starts=tuple(sorted({one.start_digest for one in demonstrations})),
        settings={
            "reads": config.model_dump(mode="json"),
            "num_readers": len(readers),
            "model": found.digest,
        },
        metrics=metrics,
    )
    return Checkpoint(metadata, tensors)


def run_train_policy(arguments: list[str]) -> int:
    """Train a cloned policy, or with `--places` a policy of places, and save it."""
    settings = load_settings(TrainPolicySettings, arguments)
    if settings.places is None:
        return evaluation.run_train_policy(arguments)
    unused = [
        flag
        for flag, is_given in {
            "--early-at": settings.early_at is not None,
            "--training": settings.training != CloningSettings(),
        }.items()
        if is_given
    ]
    if unused:
        raise InvalidInputError(
            f"train policy --places: got {' and '.join(unused)}, expected neither: the policy is "
            "fitted in one go, without training steps"
        )
    checkpoint = train_place_policy(
        read_demonstrations(settings), settings.places, command=command_line("policy", arguments)
    )
    return evaluation.keep(checkpoint, settings.output, settings.json_path)
