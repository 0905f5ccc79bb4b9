"""One rollout of a policy in a world from a matched start, and its score."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from dextouch.clients import Policy, Rollout
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError
from dextouch.schemas import (
    MAX_SEED,
    Observation,
    ReturnSelector,
    RolloutDoubt,
    rollout_doubt,
)
from dextouch.streams import HEAD_CAMERA
from dextouch.tracing import current_trace_id, in_trace
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.matched_starts import (
    FailedStart,
    MatchedStart,
    first_digest,
    rollout_failure,
)
from services.evaluation.policies.outside import action_chunk, ask
from services.evaluation.scores import REAL, Outcome, RolloutScore
from services.evaluation.study_worlds import StudyWorlds
from services.evaluation.success_classifier import SuccessClassifier

# Repeats of an imagined rollout differ by this in the seed of their noise.
_REPEAT_STRIDE = 2**40


@dataclass(frozen=True)
class PlayedRollout:
    """What happened in a finished rollout.

    `observations` are those of step 0 and of every chunk; `commanded` [T, 67] are the actions, row
    0 the poses of step 0; `success` is the world's own report, None if it has none. `trace_id` is
    that of its requests.
    """

    observations: Sequence[Observation]
    commanded: Float64[np.ndarray, "steps 67"]
    success: bool | None
    trace_id: str | None = None

    @property
    def ending(self) -> Observation:
        """The observation of the last chunk."""
        return self.observations[-1]

    @property
    def doubt(self) -> RolloutDoubt:
        """The world's doubt of the whole rollout."""
        return rollout_doubt(self.observations)


@dataclass(frozen=True)
class RolloutRunner:
    """Runs rollouts one at a time; not thread-safe, as its connections are not.

    Args:
        worlds: the real world and the imagined ones.
        probe: success classifier of all worlds that have none of their own.
        num_steps: steps of a rollout on the model grid.
        shows_all: whether the head camera's images of all steps are requested. Otherwise worlds
            render only the images that the policy uses, and the ending.
        own_probes: success classifiers that were calibrated for single worlds, by world.
    """

    worlds: StudyWorlds
    probe: SuccessClassifier
    num_steps: int
    shows_all: bool = False
    own_probes: Mapping[str, SuccessClassifier] = field(default_factory=dict)

    def outcome(
        self, start: MatchedStart | FailedStart, actor: Policy, policy: str, world: str
    ) -> Outcome:
        """Play and score one rollout; an error becomes a failure with its reason."""
        return self.run(start, actor, policy, world)[0]

    def run(
        self,
        start: MatchedStart | FailedStart,
        actor: Policy,
        policy: str,
        world: str,
        repeat: int = 0,
    ) -> tuple[Outcome, PlayedRollout | None]:
        """Play and score one rollout.

        Args:
            start: where it begins.
            actor: the policy.
            policy: its name.
            world: name of the world.
            repeat: number of the repeat; imagined worlds give each its own noise.

        Returns:
            Its outcome, and what happened unless it failed.
        """
        if isinstance(start, FailedStart):
            return rollout_failure(start.error, start, policy, world, repeat), None
        try:
            with in_trace():
                played = self._play(start, actor, policy, world, repeat)
            ending = Ending.of(
                played.ending, start.task, imagined=world != REAL, doubt=played.doubt
            )
        except DexTouchError as error:
            return rollout_failure(error, start, policy, world, repeat), None
        verdict = self.own_probes.get(world, self.probe).verdict(ending)
        score = RolloutScore(
            world,
            policy,
            start.task,
            start.seed,
            start.digest,
            verdict.likely_success if played.success is None else played.success,
            verdict.probability,
            cannot_tell=None if played.success is not None else verdict.reason,
            repeat=repeat,
            world_probability=verdict.world_probability,
        )
        return score, played

    def _begin(self, start: MatchedStart, policy: str, world: str, repeat: int) -> Rollout:
        """Start a rollout from a matched start (by task and seed in the real world).

        Raises:
            ConflictError: the real world started differently than before.
        """
        address = self.worlds.addresses[world]
        client = address.client.selecting(ReturnSelector(cameras=self.worlds.cameras), name=policy)
        is_real = world == REAL
        rollout = client.start(
            world=address.world,
            task=start.task,
            seed=start.seed if is_real else (start.seed + repeat * _REPEAT_STRIDE) % MAX_SEED,
            instruction=start.instruction,
            init=None if is_real else (start.observation, start.anchor, start.K_head),
            action_kind=start.action_kind,
        )
        if is_real and first_digest(rollout.observation) != start.digest:
            rollout.close()
            raise ConflictError(
                f"world {address.world!r}: task {start.task!r} with seed {start.seed} began "
                "differently than before; matched starts need a deterministic world"
            )
        return rollout

    def _play(
        self, start: MatchedStart, actor: Policy, policy: str, world: str, repeat: int
    ) -> PlayedRollout:
        """Run a policy in a rollout."""
        description = self.worlds.descriptions[world]
        where = f"policy {policy!r}, task {start.task!r}, seed {start.seed}"
        with self._begin(start, policy, world, repeat) as rollout:
            seen = [rollout.observation]
            commanded = [rollout.observation.action_reached[-1:]]
            # The world's images may be smaller than that of the start.
            given = replace(start.for_policy(), K_head=rollout.K_head)
            ask(actor.reset, given, where=f"{where}: reset")
            while (left := self.num_steps - rollout.info.last_step) > 0:
                acting = f"{where}, chunk {rollout.info.next_chunk}: act"
                answer = ask(actor.act, rollout.observation, where=acting)
                chunk = action_chunk(answer, description, where=acting)[:left]
                commanded.append(chunk)
                looks, multiple = getattr(actor, "looks", True), description.chunk_multiple
                seen += self._step(rollout, chunk, left, looks=looks, multiple=multiple)
            success = rollout.observation.success if world == REAL else None
        if len(seen[-1]) < NUM_SEEN_STEPS:
            raise InvalidInputError(
                f"{where}: the last chunk has {len(seen[-1])} steps, expected at least "
                f"{NUM_SEEN_STEPS}; send longer chunks"
            )
        return PlayedRollout(seen, np.concatenate(commanded), success, current_trace_id())

    def _step(
        self, rollout: Rollout, chunk: np.ndarray, left: int, *, looks: bool | str, multiple: int
    ) -> list[Observation]:
        """Advance by a chunk; images, which take most of the time, only where they are needed.

        Args:
            rollout: the rollout.
            chunk: actions to execute.
            left: steps to the end of the rollout, including this chunk.
            looks: attribute of the policy; see `dextouch.clients.Policy`.
            multiple: of the world's chunks.
        """
        cameras, is_last = self.worlds.cameras, len(chunk) == left
        if self.shows_all or looks is True or (looks and is_last):
            shown = ReturnSelector(cameras=cameras if looks else (HEAD_CAMERA,))
            return [rollout.step(chunk, selector=shown, validated=True)]
        if looks:
            newest = ReturnSelector(cameras=cameras, steps="last")
            return [rollout.step(chunk, selector=newest, validated=True)]
        # Only the ending is rendered, in a chunk of its own.
        num_shown = -(-NUM_SEEN_STEPS // multiple) * multiple if is_last else 0
        num_unseen = max(len(chunk) - num_shown, 0)
        seen = []
        if num_unseen:
            blind = ReturnSelector(cameras=())
            seen.append(rollout.step(chunk[:num_unseen], selector=blind, validated=True))
        if num_unseen < len(chunk):
            seen.append(rollout.step(chunk[num_unseen:], validated=True))
        return seen
