"""Options of a take, and the mixes of takes that make up data sets (`dextouch train data`)."""

import re
import zlib
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, check_actions
from services.twin.demonstrators import NUM_GRID_STEPS, Motion
from services.twin.mistakes import DEVELOPMENT, TRAINING, Mistake
from services.twin.names import CAMERAS, MOTION_KINDS, Domain, MotionKind, StreamChoice
from services.twin.scene import USUAL, Sizes

# Success is decided within about 5 mm, so the levels are dense there.
LADDER_M: Final = (0.0, 0.0025, 0.005, 0.0075, 0.010, 0.015, 0.020, 0.030, 0.040)
# Largest noise; each take draws its own standard deviation uniformly between 0 and this.
NOISE_RANGES_M: Final = {"fine": 0.012, "medium": 0.025, "coarse": 0.040}
# Ranges of the first step of a deviation (end excluded); nothing is reached before step 8.
_FROM_STEPS: Final = {
    "frozen": (8, 70),
    "retreat": (5, 70),
    "slip": (18, 51),
    "push": (8, 55),
    "wander": (8, 55),
}
# Share of pushes and wanders that replace the script from the first step on.
_AT_ONCE: Final = 0.7
# Seeds of one purpose (training, development, evaluation) form blocks of this size.
_SEED_BLOCK: Final = 10_000
_SUM_TOLERANCE: Final = 1e-9
# Shares of takes with one, two, three and four mistakes, and of those with a noisy script.
_COUNTS: Final = (0.45, 0.30, 0.15, 0.10)
_NOISY: Final = 0.4
# Largest strength of a single mistake, where a task succeeds about half of the time.
STRENGTHS: Final = {"stand_bottle": 0.7}


@dataclass(frozen=True)
class TakeOptions:
    """Options of a demonstration and its recording.

    `noise_m` is the demonstrator's error (0 … 0.2 m), `miss` moves or removes the objects while the
    motion stays, `images` are the cameras to record. At most one of three modifies the commands:
    `frozen_from_step` (0 … 80) freezes them from that step on, `motion` replaces the script, and
    `actions_of_seed` plays the demonstration of another seed, relative to this take's start.
    `mistakes` change the commands of the script, in their order; with `varied`, colours, light and
    the home of the head camera differ from take to take. Cameras record at 30 Hz, or at grid steps
    that are multiples of `image_every` and the last three; with `training` streams, only touch,
    images, actions, and object poses at grid steps are recorded.
    """

    noise_m: float = 0.0
    miss: bool = False
    images: tuple[str, ...] = CAMERAS
    frozen_from_step: int | None = None
    motion: Motion | None = None
    actions_of_seed: int | None = None
    image_every: int | None = None
    streams: StreamChoice = "all"
    mistakes: tuple[Mistake, ...] = ()
    varied: bool = False
    sizes: Sizes = USUAL

    def __post_init__(self) -> None:
        frozen = self.frozen_from_step
        if frozen is not None and not 0 <= frozen < NUM_GRID_STEPS:
            raise InvalidInputError(
                f"twin: got commands frozen from step {frozen}, expected a step "
                f"0 … {NUM_GRID_STEPS - 1}"
            )
        changes = (frozen, self.motion, self.actions_of_seed)
        if sum(change is not None for change in changes) > 1:
            raise InvalidInputError(
                f"twin: got frozen_from_step {frozen}, motion {self.motion} and actions_of_seed "
                f"{self.actions_of_seed}, expected at most one of them"
            )
        if self.mistakes and any(change is not None for change in changes):
            raise InvalidInputError(
                f"twin: got mistakes {', '.join(map(str, self.mistakes))} of a script that is "
                f"replaced ({changes}), expected one or the other"
            )
        every = self.image_every
        if every is not None and not 1 <= every < NUM_GRID_STEPS:
            raise InvalidInputError(
                f"twin: got images every {every} steps, expected 1 … {NUM_GRID_STEPS - 1}"
            )
        for camera in self.images:
            if camera not in CAMERAS:
                raise UnknownNameError("camera", camera, list(CAMERAS))

    def words(self) -> list[str]:
        """Equivalent flags of `dextouch twin record`."""
        words = ["--noise", repr(self.noise_m), "--miss-fraction", repr(float(self.miss))]
        if self.images != CAMERAS:
            words += ["--cameras", *self.images]
        if self.frozen_from_step is not None:
            words += ["--freeze-from", str(self.frozen_from_step)]
        if self.motion is not None:
            words += ["--motion", self.motion.kind, "--motion-from", str(self.motion.from_step)]
        if self.actions_of_seed is not None:
            words += ["--actions-of", str(self.actions_of_seed)]
        if self.image_every is not None:
            words += ["--image-every", str(self.image_every)]
        if self.streams != "all":
            words += ["--streams", self.streams]
        for mistake in self.mistakes:
            words += ["--mistake", str(mistake)]
        if self.varied:
            words.append("--varied")
        if self.sizes != USUAL:
            words += ["--width", repr(self.sizes.width), "--height", repr(self.sizes.height)]
        return words

    def figures(self) -> dict[str, float]:
        """Entries of an episode's `quality` about its options."""
        figures = {"noise_m": self.noise_m, "miss": float(self.miss)}
        if self.frozen_from_step is not None:
            figures["frozen_from_step"] = float(self.frozen_from_step)
        if self.motion is not None:
            figures[f"{self.motion.kind}_from_step"] = float(self.motion.from_step)
        if self.actions_of_seed is not None:
            figures["actions_of_seed"] = float(self.actions_of_seed)
        figures |= {f"mistake_{one.kind}": one.strength for one in self.mistakes}
        if self.sizes != USUAL:
            figures |= {"width": self.sizes.width, "height": self.sizes.height}
        return figures


@dataclass(frozen=True)
class PlayedActions:
    """Commands of a take, relative to its start, row 0 being its pose, from another source.

    `name` becomes part of the episode's id; `command` is the command that reproduces the episode.
    """

    name: str
    actions: Float64[np.ndarray, "steps 67"]
    command: str

    def __post_init__(self) -> None:
        if re.fullmatch(r"[a-z0-9_]{1,48}", self.name) is None:
            raise InvalidInputError(
                f"twin: got played actions named {self.name!r}, expected 1 … 48 of a-z, 0-9 and _"
            )
        checked = check_actions(self.actions, where="twin: played actions")
        if len(checked) != NUM_GRID_STEPS:
            raise ShapeError(
                f"twin: got {len(checked)} played actions, expected {NUM_GRID_STEPS} rows of "
                f"{ACTION_DIM}"
            )


def episode_id(
    task: str, domain: Domain, seed: int, options: TakeOptions, *, played: str | None = None
) -> str:
    """Descriptive id of an episode, unique for each combination of options and actions `played`."""
    parts = ["twin", task, domain, f"{seed:06d}"]
    parts += [f"n{round(options.noise_m * 1e6)}um"] * (options.noise_m > 0)
    parts += ["miss"] * options.miss
    if options.frozen_from_step is not None:
        parts.append(f"f{options.frozen_from_step}")
    if options.motion is not None:
        parts.append(f"{options.motion.kind}{options.motion.from_step}")
    if options.actions_of_seed is not None:
        parts.append(f"of{options.actions_of_seed:06d}")
    parts += [f"{one.kind}{round(1000 * one.strength)}" for one in options.mistakes]
    parts += ["varied"] * options.varied
    parts += options.sizes.labels
    if played is not None:
        parts.append(f"by_{played}")
    if options.image_every is not None:
        parts.append(f"i{options.image_every}")
    if options.streams != "all":
        parts.append(options.streams)
    return "-".join(parts)


@dataclass(frozen=True)
class Mix:
    """Shares of the kinds of takes in a data set; they sum to 1.

    Scripts: `exact`, with noise of up to 12 (`fine`), 25 (`medium`) or 40 mm (`coarse`) standard
    deviation, or with the levels `LADDER_M` cycled over the seeds (`ladder`). The other kinds have
    the noise of a script: `miss` has displaced objects; `frozen` stops midway and `hold` never
    starts; the `MOTION_KINDS`; `other_scene` plays the actions of another seed; `mistaken` has one
    to four mistakes of `TRAINING`, `otherwise_mistaken` one of `DEVELOPMENT`.
    """

    exact: float = 0.0
    fine: float = 0.0
    medium: float = 0.0
    coarse: float = 0.0
    ladder: float = 0.0
    miss: float = 0.0
    frozen: float = 0.0
    hold: float = 0.0
    retreat: float = 0.0
    push: float = 0.0
    slip: float = 0.0
    other_scene: float = 0.0
    wander: float = 0.0
    mistaken: float = 0.0
    otherwise_mistaken: float = 0.0

    def __post_init__(self) -> None:
        shares = asdict(self)
        for name, share in shares.items():
            if not 0 <= share <= 1:
                raise InvalidInputError(f"training data: got a share of {name} {share}, not 0 … 1")
        total = sum(shares.values())
        if abs(total - 1) > _SUM_TOLERANCE:
            raise InvalidInputError(
                f"training data: got shares that sum to {total:.6g}, expected 1 ({shares})"
            )
        if not any(getattr(self, name) for name in SCRIPTS):
            raise InvalidInputError(
                f"training data: got no share of any script, expected some of {list(SCRIPTS)}"
            )

    def changed(self, *, miss: float | None = None, still: float | None = None) -> "Mix":
        """Copy with another share, 0 … 1, of misses, or of takes that stop or never start."""
        given = {} if miss is None else {"miss": miss}
        if still is not None:
            given |= {"frozen": 0.5 * still, "hold": 0.5 * still}
        rest = {name: share for name, share in asdict(self).items() if name not in given}
        left, before = 1 - sum(given.values()), sum(rest.values())
        if not left >= 0 or before == 0:
            raise InvalidInputError(
                f"training data: got a share {miss} of misses and {still} of takes that stop, "
                "expected 0 … 1 in all"
            )
        return replace(self, **given, **{name: s * left / before for name, s in rest.items()})


SCRIPTS: Final = ("exact", "fine", "medium", "coarse", "ladder")
MIXES: Final[dict[str, Mix]] = {
    "evaluator": Mix(
        exact=0.05, fine=0.08, coarse=0.05, ladder=0.04, miss=0.04, frozen=0.02, hold=0.02,
        retreat=0.02, push=0.02, slip=0.02, other_scene=0.02, wander=0.01, mistaken=0.61,
    ),
    "demonstrations": Mix(exact=0.28, medium=0.52, miss=0.20),
    "ladder": Mix(ladder=1.0),
    "development": Mix(ladder=0.4, otherwise_mistaken=0.6),
    "exact": Mix(exact=1.0),
}  # fmt: skip


def options_of(task: str, seed: int, mix: Mix) -> TakeOptions:
    """Options of the take of a task and a seed, 0 or more; deterministic."""
    if seed < 0:
        raise InvalidInputError(f"training data: got seed {seed}, expected 0 or more")
    draw = np.random.default_rng([seed, zlib.crc32(task.encode())])
    shares = asdict(mix)
    kind = _drawn(shares, draw)
    script = kind if kind in SCRIPTS else _drawn({n: shares[n] for n in SCRIPTS}, draw)
    noise_m = _noise_m(script, seed, draw)
    if kind in {"frozen", "hold"}:
        step = int(draw.integers(*_FROM_STEPS["frozen"]))
        return (
            TakeOptions(noise_m, frozen_from_step=step)
            if kind == "frozen"
            else TakeOptions(frozen_from_step=0)
        )
    if kind == "other_scene":
        return TakeOptions(noise_m, actions_of_seed=_another_seed(seed, draw))
    if kind in MOTION_KINDS:
        return _with_motion(kind, noise_m, draw)
    if kind == "otherwise_mistaken":
        name, strength = draw.choice(list(DEVELOPMENT)), np.round(draw.uniform(), 3)
        return TakeOptions(mistakes=(Mistake(str(name), float(strength)),))
    if kind == "mistaken":
        noise_m = _noise_m("fine", seed, draw) if draw.random() < _NOISY else 0.0
        return TakeOptions(noise_m, mistakes=mistakes_of(task, draw))
    return TakeOptions(noise_m, miss=kind == "miss")


def mistakes_of(task: str, draw: np.random.Generator) -> tuple[Mistake, ...]:
    """One to four mistakes of the training kinds, weaker where a task forgives less."""
    count = 1 + int(draw.choice(len(_COUNTS), p=_COUNTS))
    kinds = draw.choice(list(TRAINING), size=count, replace=False)
    largest = STRENGTHS.get(task, 1.0) / count**0.5
    strengths = np.round(draw.uniform(0, largest, size=count), 3)
    return tuple(Mistake(str(kind), float(s)) for kind, s in zip(kinds, strengths, strict=True))


def _with_motion(kind: str, noise_m: float, draw: np.random.Generator) -> TakeOptions:
    motions: dict[str, MotionKind] = {kind: kind for kind in MOTION_KINDS}
    motion = Motion(motions[kind], int(draw.integers(*_FROM_STEPS[kind])))
    if kind in {"push", "wander"} and draw.random() < _AT_ONCE:
        # Without a script there is no script noise.
        return TakeOptions(motion=replace(motion, from_step=0))
    return TakeOptions(noise_m, motion=motion)


def _drawn(shares: dict[str, float], draw: np.random.Generator) -> str:
    ends = np.cumsum(list(shares.values()))
    place = int(np.searchsorted(ends, draw.random() * ends[-1], side="right"))
    return list(shares)[place]


def _noise_m(script: str, seed: int, draw: np.random.Generator) -> float:
    if script == "ladder":
        return LADDER_M[seed % len(LADDER_M)]
    if script == "exact":
        return 0.0
    # Rounded to a tenth of a millimetre, since it is part of the episode's name.
    return float(np.round(draw.uniform(0, NOISE_RANGES_M[script]), 4))


def _another_seed(seed: int, draw: np.random.Generator) -> int:
    """Another seed of the same block, so that no evaluation scene is trained on."""
    first = seed - seed % _SEED_BLOCK
    step = int(draw.integers(1, _SEED_BLOCK))
    return first + (seed - first + step) % _SEED_BLOCK
