"""Schemas of rollouts without arrays: worlds, requests to start and fork, and their progress."""

from collections.abc import Mapping
from operator import not_
from typing import Final, Literal

from pydantic import ConfigDict, Field, model_validator

from dextouch.errors import InvalidInputError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel, example
from dextouch.schemas.common import MAX_INSTRUCTION
from dextouch.tactile import LayoutDescription

ActionKind = Literal["measured", "commanded"]
WorldKind = Literal["twin", "model", "baseline", "robot"]
MAX_SEED = 2**63 - 1  # an int64
# Of one hand of a `dextouch_v1`.
_USUAL_TAXELS: Final = 320
# Steps of an action chunk at the model rate of 15 Hz, as in the paper: the usual length, which
# policies, models in the paper's form and comparisons have.
CHUNK_STEPS: Final = 16
# In `info` of a response: the largest figure of the chunk's uncertainty as a share of its bound.
BOUND_SHARE: Final = "uncertainty/bound_share"
# Version 1 of the API says doubt for uncertainty, and so does the episode format.
WIRE_NAMES: Final = ConfigDict(validate_by_name=True, serialize_by_alias=True)
# Quality figures of imagined episodes, and the fields of `RolloutUncertainty` that they hold.
_QUALITY: Final = {
    "imagined_doubted_step": "step",
    "imagined_success_probability": "success_probability",
    "imagined_success_spread": "success_spread",
    "imagined_size_deviation": "size_deviation",
}
# Of these, the world's own estimates after a chunk.
_ESTIMATES: Final = ("success_probability", "success_spread", "size_deviation")

# Names of numbers by which a world reports milestones of the task, 1 where a step of the chunk
# reached one and 0 where none did.
MILESTONE_PREFIX: Final = "milestone/"


def reported_milestones(info: Mapping[str, float]) -> dict[str, float]:
    """Milestones by name among the numbers that a world reports about a chunk."""
    return {
        name.removeprefix(MILESTONE_PREFIX): value
        for name, value in info.items()
        if name.startswith(MILESTONE_PREFIX)
    }


class WorldDescription(FrozenModel):
    """Capabilities of a world, exchanged before a rollout.

    Attributes:
        name: by which rollouts are started in it.
        kind: a simulation, a learned model, a trivial baseline, or a robot.
        digest: of everything that decides its responses; equal digests respond alike.
        tasks: names of tasks that it can start.
        model_rate_hz: steps a second; a row of an action chunk is one step.
        action_kinds: which poses it takes as actions: those sent to hands, or those they reached.
        starts_from: a task and seed, or an observation, which is sent as MessagePack.
        chunk_multiple: the number of rows of a chunk is a multiple of it.
        max_chunk_steps: the largest number of rows of a chunk.
        knows_success: whether observations say if the task is done.
        object_names: by task, the objects whose poses are in its observations; empty for a world
            without object poses.
        optional_cameras: a start may have their images, too, and then answers have them if they are
            asked for by name.
        predicts_touch: if false, touch is zero in its observations.
        scales_images: if true, images of a start may have another size: the middle square is
            scaled to the world's size, and the rollout's `K_head` is of the scaled image.
        tactile_layout: of the taxels in all observations; without it, that of `dextouch_v1`.
    """

    name: str
    kind: WorldKind
    digest: str
    tasks: tuple[str, ...]
    cameras: tuple[str, ...]
    image_height_px: int
    image_width_px: int
    model_rate_hz: float
    action_kinds: tuple[ActionKind, ...]
    starts_from: tuple[Literal["task_seed", "observation"], ...]
    chunk_multiple: int = 4
    max_chunk_steps: int = 64
    knows_success: bool = False
    object_names: dict[str, tuple[str, ...]] = Field(default={})
    optional_cameras: tuple[str, ...] = Field(default=(), exclude_if=not_)
    predicts_touch: bool = Field(default=True, exclude_if=bool)
    scales_images: bool = Field(default=False, exclude_if=not_)
    tactile_layout: LayoutDescription | None = Field(
        default=None, exclude_if=lambda one: one is None
    )

    @property
    def num_taxels(self) -> int:
        """Taxels of one hand in observations."""
        return _USUAL_TAXELS if self.tactile_layout is None else self.tactile_layout.num_taxels

    def check_rate(self, rate_hz: float, *, of: str) -> None:
        """Refuse steps at another rate, by InvalidInputError; `of` says whose they are."""
        if rate_hz != self.model_rate_hz:
            raise InvalidInputError(
                f"world {self.name!r}: got {of} at {rate_hz:g} steps a second, expected "
                f"{self.model_rate_hz:g}; align or import episodes at the rate of the world"
            )


class WorldList(FrozenModel):
    """Response of GET /v1/worlds."""

    worlds: tuple[WorldDescription, ...]


class StartRequest(FrozenModel):
    """The fields of POST /v1/rollouts; an observation to start from is sent as arrays.

    Attributes:
        world: one of `list_worlds`.
        task: one of the world's tasks.
        seed: of the start where the world places its objects, and of the noise of a model.
        instruction: sentence that describes the task.
        action_kind: whether actions are poses to be reached, or poses that were reached.
    """

    model_config = example(
        world="twin", task="stand_bottle", seed=3, instruction="Stand the bottle upright."
    )

    world: FreeText
    task: FreeText
    seed: int = Field(ge=0, le=MAX_SEED)
    instruction: FreeText = Field(max_length=MAX_INSTRUCTION)
    action_kind: ActionKind = "commanded"


class ForkRequest(FrozenModel):
    """The body of POST /v1/rollouts/{id}/fork; a new seed gives the branch its own noise."""

    model_config = example(seed=7)

    seed: int | None = Field(default=None, ge=0, le=MAX_SEED)


class Uncertainty(FrozenModel):
    """Uncertainty of an imagining world about its prediction.

    `disagreement` and `distance` are non-negative, and comparable within one world digest only. The
    last three fields are omitted by a world that does not estimate them.

    Attributes:
        disagreement: between several predictions of the same steps.
        distance: of the rollout from the training distribution, by what the world compares: the
            state model's is of the hands' motion.
        outside: whether the world's own bound is exceeded, so that the prediction is unreliable.
        reason: why it is outside; None otherwise.
        success_probability: probability that the task is done after these steps, in the world's own
            estimate: the mean over ensemble members and possible starts.
        success_spread: largest difference between the probabilities of two members.
        size_deviation: how much the size of an object differs from the usual one at most, as a
            share of it: 0.2 for a bottle seen 20 % thicker than those of training usually are.
    """

    disagreement: float = Field(ge=0, allow_inf_nan=False)
    distance: float = Field(ge=0, allow_inf_nan=False)
    outside: bool = False
    reason: str | None = Field(default=None, min_length=1, max_length=500)
    success_probability: float | None = Field(
        default=None, ge=0, le=1, exclude_if=lambda one: one is None
    )
    success_spread: float | None = Field(
        default=None, ge=0, le=1, exclude_if=lambda one: one is None
    )
    size_deviation: float | None = Field(
        default=None, ge=0, allow_inf_nan=False, exclude_if=lambda one: one is None
    )

    @model_validator(mode="after")
    def _a_reason_if_outside(self) -> "Uncertainty":
        if self.outside != (self.reason is not None):
            raise ValueError(
                f"got outside {self.outside} with reason {self.reason!r}, expected a reason where "
                "outside is true and none where it is not"
            )
        return self


class RolloutUncertainty(FrozenModel):
    """What the uncertainty of all chunks of a rollout says about its outcome.

    An outcome depends on every step before it, so one unreliable chunk makes the rest of the
    rollout unreliable, too.

    Attributes:
        reason: of the first chunk that was outside the world's bound; None if none was.
        step: last step of that chunk.
        success_probability: of the newest chunk; None where the world does not estimate it.
        success_spread: of the newest chunk.
        size_deviation: of the newest chunk.
    """

    reason: str | None = None
    step: int | None = None
    success_probability: float | None = None
    success_spread: float | None = None
    size_deviation: float | None = None

    def after(self, uncertainty: Uncertainty | None, *, last_step: int) -> "RolloutUncertainty":
        """The uncertainty of the rollout after one more chunk, which ends at `last_step`.

        That of the chunk is None where the world reports none.
        """
        reason, step = self.reason, self.step
        if reason is None and uncertainty is not None and uncertainty.outside:
            reason, step = uncertainty.reason, last_step
        newest = {name: getattr(uncertainty, name, None) for name in _ESTIMATES}
        return RolloutUncertainty(reason=reason, step=step, **newest)

    def to_quality(self) -> dict[str, float]:
        """The known numbers as quality figures of an episode; the reason's text is lost."""
        known = {figure: getattr(self, name) for figure, name in _QUALITY.items()}
        return {figure: float(value) for figure, value in known.items() if value is not None}

    @staticmethod
    def from_quality(quality: Mapping[str, float]) -> "RolloutUncertainty":
        """The uncertainty that `to_quality` noted; unknown where an episode has no such figures."""
        known = {name: quality.get(figure) for figure, name in _QUALITY.items()}
        reason = None if known["step"] is None else "the world called its prediction unreliable"
        return RolloutUncertainty.model_validate(known | {"reason": reason})


class RolloutInfo(FrozenModel):
    """State of a rollout.

    Attributes:
        next_chunk: the only chunk number accepted next.
        last_step: of the newest observation; 0 is the start.
        ttl_s: seconds without a chunk after which it expires.
        ended: why its world cannot continue it; omitted while it can.
        rollout_uncertainty: of all chunks so far; omitted while the world reports none.
    """

    model_config = WIRE_NAMES

    id: str
    world: str
    world_digest: str
    task: str
    instruction: str
    seed: int
    action_kind: ActionKind
    next_chunk: int
    last_step: int
    ttl_s: float
    ended: str | None = Field(default=None, exclude_if=lambda one: one is None)
    rollout_uncertainty: RolloutUncertainty | None = Field(
        default=None, exclude_if=lambda one: one is None, alias="rollout_doubt"
    )

    def after(self, uncertainty: Uncertainty | None, num_steps: int) -> "RolloutInfo":
        """The state after one more chunk of this uncertainty and number of steps."""
        last_step, so_far = self.last_step + num_steps, self.rollout_uncertainty
        if uncertainty is not None or so_far is not None:
            so_far = (so_far or RolloutUncertainty()).after(uncertainty, last_step=last_step)
        return self.model_copy(
            update={
                "next_chunk": self.next_chunk + 1,
                "last_step": last_step,
                "rollout_uncertainty": so_far,
            }
        )


class WatchedRollout(FrozenModel):
    """A rollout as it is shown to those who watch it, and who can neither advance nor end it.

    Attributes:
        watch_id: to read its newest response with; the rollout's own id cannot be derived from it.
        client: what the client says about itself, such as the name of a policy; may be empty.
        key: name of the API key that began it; empty without keys.
        age_s: since its start.
        idle_s: since its newest chunk, or its start.
        uncertainty: of the newest chunk; None where the world reports none.
        rollout_uncertainty: of all chunks so far; None where the world reports none.
        success: at the newest step; None where unknown.
        trace_id: of the request that began it; None if another version of DexTouch began it.
    """

    model_config = WIRE_NAMES

    watch_id: str
    world: str
    world_digest: str
    task: str
    instruction: str
    seed: int
    next_chunk: int
    last_step: int
    ttl_s: float
    ended: str | None = None
    client: str = ""
    key: str = ""
    age_s: float
    idle_s: float
    uncertainty: Uncertainty | None = Field(default=None, alias="doubt")
    rollout_uncertainty: RolloutUncertainty | None = Field(default=None, alias="rollout_doubt")
    success: bool | None = None
    trace_id: str | None = None


class WatchedRollouts(FrozenModel):
    """Response of GET /v1/watch: the newest rollouts first, and how many there are.

    Attributes:
        over: those that their clients ended last, the newest first, as they were then,
            but for `age_s` and `idle_s`, which go on.
    """

    rollouts: tuple[WatchedRollout, ...]
    num_open: int
    over: tuple[WatchedRollout, ...] = ()
