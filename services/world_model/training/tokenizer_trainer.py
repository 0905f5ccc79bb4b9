"""Pretraining of tactile tokenizers on the touch of single hands, before any world model."""

import copy
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeStore,
    Split,
    data_hash,
    scene_fraction,
    select_episodes,
)
from dextouch.errors import InvalidInputError
from dextouch.metrics import tactile as tactile_metrics
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout, common_layout
from services.networks import optimizer
from services.world_model import checkpoints
from services.world_model.dynamics.features import root_pressure
from services.world_model.network.tactile import LearnedTokenizer, TactileTokenizer, build_tokenizer
from services.world_model.paper_settings import TrainSettings, TrainTokenizerSettings
from services.world_model.training.joint_dataset import E, TrainingEpisode
from services.world_model.training.scene_table import filled_touch

_EVALUATION_BATCH, _TIMING_ROUNDS = 1000, 5
# Chosen: decay of the averaged weights, for runs of some thousand steps.
_EMA_DECAY = 0.99
OnEvaluation = Callable[[float, checkpoints.Reconstruction], None]
# By scene: the touch of each episode, and its content.
_Side = dict[str, list[tuple[np.ndarray, str]]]


@dataclass(frozen=True)
class TactileHands:
    """Measured touch of hands of some scenes at the model rate, with the hash of their episodes."""

    tactile_kpa: Float32[np.ndarray, "hands taxels"]
    scenes: tuple[str, ...]
    data_hash: str
    layout: TactileLayout = DEXTOUCH_V1


def load_hands(
    urls: Sequence[str], *, splits: Collection[Split] = (), heldout_share: float
) -> tuple[TactileHands, TactileHands]:
    """Training and held-out hands of all people and robots; a scene is on one side only.

    Raises:
        InvalidInputError: either side has no scene, or the episodes are of several gloves.
        NotFoundError, ConflictError: as `select_episodes`.
    """
    sides: tuple[_Side, _Side] = ({}, {})
    layouts = []
    for reader in select_episodes([EpisodeStore(url) for url in urls], splits=splits):
        grid = EpisodeGrid(reader)
        layouts.append(grid.tactile_layout)
        touch_kpa, is_measured = filled_touch(grid)
        side = sides[scene_fraction(grid.scene) < heldout_share]
        side.setdefault(grid.scene, []).append((touch_kpa[is_measured], grid.content_sha256))
    if not all(sides):
        raise InvalidInputError(
            f"tokenizer: got {len(sides[0])} scenes to train on and {len(sides[1])} held out, "
            "expected at least one each; add episodes or change --heldout-share"
        )
    layout = common_layout(layouts, what="tokenizer: episodes")
    training, heldout = (_hands(side, layout) for side in sides)
    return training, heldout


def _hands(side: _Side, layout: TactileLayout) -> TactileHands:
    touch_kpa, contents = zip(*chain(*side.values()), strict=True)
    together = np.concatenate(touch_kpa)
    return TactileHands(together, tuple(sorted(side)), data_hash(contents), layout)


@dataclass(frozen=True)
class TokenizerReport:
    """Result of a run; times are medians of encoding and decoding on this machine."""

    checkpoint: Path
    metadata: checkpoints.TokenizerMetadata
    digest: str
    ms_per_1000_hands: float


def train_tokenizer(
    settings: TrainTokenizerSettings, on_evaluation: OnEvaluation | None = None
) -> TokenizerReport:
    """Train a tokenizer, evaluate it on held-out scenes and write it.

    Raises:
        InvalidInputError: no scene to train on or none held out, or no touch at all.
    """
    torch.set_num_threads(settings.num_threads)
    training, heldout = load_hands(
        settings.episodes, splits=settings.splits, heldout_share=settings.heldout_share
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        tokenizer = build_tokenizer(settings.network().with_layout(training.layout))
    tokenizer.fit(torch.from_numpy(training.tactile_kpa)[:, None].expand(-1, 2, -1))
    budget = optimizer.Budget(settings.cpu_budget_s, settings.max_steps)
    curve: list[checkpoints.Reconstruction] = []

    def evaluate(current: TactileTokenizer) -> None:
        with budget.paused():
            curve.append(reconstruction(current, heldout, budget))
            if on_evaluation is not None:
                on_evaluation(min(budget.share(), 1.0), curve[-1])

    if isinstance(tokenizer, LearnedTokenizer):
        tokenizer = _learn(tokenizer, training, settings, budget, evaluate)
    metadata = checkpoints.TokenizerMetadata(
        tokenizer=settings.tokenizer,
        palm_channels=settings.palm_channels,
        tactile_channels=settings.tactile_channels,
        command=settings.command(),
        seed=settings.seed,
        training_steps=budget.step,
        training_cpu_s=round(budget.cpu_s, 1),
        num_parameters=sum(p.numel() for p in tokenizer.parameters()),
        num_training_hands=len(training.tactile_kpa),
        num_heldout_hands=len(heldout.tactile_kpa),
        train_scenes=training.scenes,
        data_hash=training.data_hash,
        layout=None if training.layout == DEXTOUCH_V1 else training.layout,
        curve=(
            checkpoints.Reconstruction(
                step=0, cpu_s=0, mse_kpa2=0, mae_kpa=0, contact_iou=0, contact_f1=0
            ),
        ),
    )
    checkpoints.write_tokenizer(settings.output, tokenizer, metadata)
    # Evaluate the weights as stored, then store them again with the curve.
    stored = checkpoints.read_tokenizer(settings.output).tokenizer
    evaluate(stored)
    metadata = metadata.model_copy(update={"curve": tuple(curve)})
    digest = checkpoints.write_tokenizer(settings.output, stored, metadata)
    return TokenizerReport(settings.output, metadata, digest, _ms_per_1000_hands(stored, heldout))


def _learn(
    tokenizer: LearnedTokenizer,
    training: TactileHands,
    settings: TrainTokenizerSettings,
    budget: optimizer.Budget,
    evaluate: Callable[[TactileTokenizer], None],
) -> LearnedTokenizer:
    """The moving average of the weights after training, evaluated at equal shares of the run."""
    # Untouched hands are exact with any weights.
    touched = torch.from_numpy(training.tactile_kpa[(training.tactile_kpa > 0).any(axis=1)])
    if len(touched) == 0:
        raise InvalidInputError(
            f"tokenizer: got {len(training.tactile_kpa)} hands to train on that touch nothing, "
            "expected some pressure; add episodes"
        )
    generator = torch.Generator().manual_seed(settings.seed + 1)
    averaged = copy.deepcopy(tokenizer).eval().requires_grad_(requires_grad=False)
    given = settings.optimizer
    options = optimizer.OptimizerOptions(
        given.learning_rate, 0.0, warmup_steps=given.warmup_steps, schedule=optimizer.floored_cosine
    )

    def loss() -> Tensor:
        drawn = touched[torch.randint(len(touched), (given.batch,), generator=generator)]
        return reconstruction_loss(tokenizer, drawn, contact_weight=settings.contact_weight)

    evaluate(averaged)
    num_evaluated = 0
    for _ in optimizer.OptimizerLoop(tokenizer, options, budget).run(loss):
        weights = averaged.parameters(), tokenizer.parameters()
        optimizer.update_average(*weights, decay=_EMA_DECAY, num_updates=budget.step - 1)
        due = budget.share() * settings.num_evaluations
        if num_evaluated + 1 <= due < settings.num_evaluations:
            evaluate(averaged)
            num_evaluated += 1
    return averaged


def reconstruction_loss(
    tokenizer: LearnedTokenizer,
    tactile_kpa: Float32[Tensor, "hands taxels"],
    *,
    contact_weight: float,
) -> Float32[Tensor, ""]:
    """Mean squared error of root pressures (√kPa), `contact_weight` times in contact."""
    error = tokenizer.roots(tokenizer.encode(tactile_kpa)) - root_pressure(tactile_kpa)
    weights = torch.where(tactile_kpa >= CONTACT_THRESHOLD_KPA, contact_weight, 1.0)
    return (weights * error.square()).sum() / weights.sum()


def reconstruction(
    tokenizer: TactileTokenizer, hands: TactileHands, budget: optimizer.Budget
) -> checkpoints.Reconstruction:
    """Accuracy of a tokenizer on hands, at this point of a run."""
    decoded = [
        _through(tokenizer, hands.tactile_kpa[begin : begin + _EVALUATION_BATCH])
        for begin in range(0, len(hands.tactile_kpa), _EVALUATION_BATCH)
    ]
    pair = {"predicted_kpa": np.concatenate(decoded), "true_kpa": hands.tactile_kpa}
    return checkpoints.Reconstruction(
        step=budget.step,
        cpu_s=round(budget.cpu_s, 2),
        mse_kpa2=tactile_metrics.mse(**pair, layout=hands.layout),
        mae_kpa=tactile_metrics.mae(**pair, layout=hands.layout),
        contact_iou=tactile_metrics.contact_iou(**pair, layout=hands.layout),
        contact_f1=tactile_metrics.contact_f1(**pair, layout=hands.layout),
    )


@torch.no_grad()
def _through(
    tokenizer: TactileTokenizer, tactile_kpa: Float32[np.ndarray, "hands taxels"]
) -> Float32[np.ndarray, "hands taxels"]:
    return tokenizer.decode(tokenizer.encode(torch.from_numpy(tactile_kpa))).numpy()


def _ms_per_1000_hands(tokenizer: TactileTokenizer, hands: TactileHands) -> float:
    batch = np.resize(hands.tactile_kpa, (1000, hands.tactile_kpa.shape[1]))
    times_ms = []
    for _ in range(_TIMING_ROUNDS):
        begin_s = time.process_time()
        _through(tokenizer, batch)
        times_ms.append(1000 * (time.process_time() - begin_s))
    return float(np.median(times_ms))


def with_tokenizer(
    settings: TrainSettings,
) -> tuple[TrainSettings, checkpoints.StoredTokenizer | None]:
    """The settings with the network of `--tokenizer`, and that tokenizer if one is given.

    Raises:
        InvalidInputError: a learned tokenizer of no file, or --tokenizer with --init or no touch.
        ConflictError: the network settings name another tokenizer than the file.
    """
    if settings.tokenizer is None:
        if settings.network.tokenizer != "principal_axes" and settings.init is None:
            raise InvalidInputError(
                f"training: the tokenizer {settings.network.tokenizer} is learned; train it first "
                "(dextouch train tokenizer) and give its file as --tokenizer"
            )
        return settings, None
    if not settings.network.use_touch:
        raise InvalidInputError(
            "training: got a --tokenizer for a network without touch; leave it out"
        )
    if settings.init is not None:
        raise InvalidInputError(
            "training: got --init and --tokenizer, expected one of them; the initial checkpoint "
            "holds the tokenizer that its latents come from"
        )
    stored = checkpoints.read_tokenizer(settings.tokenizer)
    network = stored.metadata.network(settings.network)
    return settings.model_copy(update={"network": network}), stored


def split_unseen(
    episodes: Sequence[E], stored: checkpoints.StoredTokenizer, *, heldout_percent: int
) -> tuple[list[E], list[E]]:
    """Training and held-out episodes, of scenes that the tokenizer has not seen; none empty."""
    sizes = Counter(episode.scene for episode in episodes)
    heldout: set[str] = set()
    for scene in sorted(sizes.keys() - set(stored.metadata.train_scenes), key=scene_fraction):
        if 100 * sum(sizes[one] for one in heldout) >= heldout_percent * len(episodes):
            break
        heldout.add(scene)
    if not 0 < len(heldout) < len(sizes):
        raise InvalidInputError(
            f"split: got {len(heldout)} of {len(sizes)} scenes to hold out that the tokenizer has "
            "not seen, expected some; give a --heldout store"
        )
    return (
        [episode for episode in episodes if episode.scene not in heldout],
        [episode for episode in episodes if episode.scene in heldout],
    )


def check_unseen(heldout: Sequence[TrainingEpisode], stored: checkpoints.StoredTokenizer) -> None:
    """Raise if the tokenizer was trained on the scene of a held-out episode."""
    seen = set(stored.metadata.train_scenes)
    both = [episode.episode_id for episode in heldout if episode.scene in seen]
    if both:
        raise InvalidInputError(
            f"training: the tokenizer was trained on the scenes of {len(both)} held-out episodes "
            f"{both[:3]}; give a --heldout store that it has not seen",
            episodes=both,
        )
