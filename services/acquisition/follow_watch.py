"""Watch that says, while hands are tracked, whether the robot's hand could follow them.

What the robot's hand can do is not known here: the check of a hand is given to the station
(`services.pipelines.station`). It runs in a thread of its own on the newest sample of each hand;
readers only leave that sample there, and a slow check skips samples.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import structlog

from dextouch.errors import DexTouchError
from dextouch.schemas import FollowCause, Matrix, RobotFollowing
from dextouch.streams import Sample, StreamDescriptor
from dextouch.tactile.layout import Side
from services.acquisition.clock import PeriodicCall, StationClock
from services.acquisition.drivers.base import Readings

logger = structlog.get_logger(__name__)

# Chosen: 30 Hz, the rate of a slow tracker, and ten checks before a cause has lasted 0.3 s.
PERIOD_NS: Final = 33_333_333
# A cause is shown for so long after it was last found: pages ask several times a second, and one
# that comes and goes within less than a reaction time is one to the operator.
HOLD_NS: Final = 300_000_000
MAX_AGE_NS: Final = 500_000_000
# A second of checks; the share in fewer says nothing of a take.
MIN_CHECKS: Final = 30
MAX_NAMED: Final = 3
WORDS: Final[Mapping[FollowCause, str]] = {
    "limit": "at the joint limit",
    "speed": "too fast",
    "reach": "out of reach",
    "unseen": "not tracked",
}
LOADING: Final = "robot's hand: not checked yet"
# Of keypoints [25, 3] as the tracker sends them and the seconds since the sample before: cause by
# finger of those that the robot cannot follow; None while the check cannot say. A DexTouchError
# says why not, and the next sample is tried again.
FollowCheck = Callable[[np.ndarray, float], Mapping[str, FollowCause] | None]
# Makes the check of a hand with the calibration of the station; may take seconds.
MakeFollowCheck = Callable[[Side, Mapping[str, Matrix]], FollowCheck]


@dataclass(frozen=True)
class FollowCounts:
    """Checks of one hand, those in which it could not be followed, and by finger and cause."""

    num_checks: int = 0
    num_missed: int = 0
    causes: Counter[tuple[str, FollowCause]] = field(default_factory=Counter)

    def plus(self, causes: Mapping[str, FollowCause]) -> "FollowCounts":
        """With one more check."""
        counted = self.causes + Counter(causes.items())
        return FollowCounts(self.num_checks + 1, self.num_missed + bool(causes), counted)

    def since(self, before: "FollowCounts") -> "FollowCounts":
        """Only what came after an earlier count."""
        num_checks = self.num_checks - before.num_checks
        causes = self.causes - before.causes
        return FollowCounts(num_checks, self.num_missed - before.num_missed, causes)

    def share(self, num: int) -> float:
        """A number of checks as a share of all."""
        return num / max(1, self.num_checks)

    def figures(self) -> dict[str, float]:
        """Share of the checks not followed, and of the worst finger by each cause that was found.

        None of less than a second of checks.
        """
        if self.num_checks < MIN_CHECKS:
            return {}
        # From the rarest to the most frequent, which stays.
        rising = reversed(self.causes.most_common())
        worst = {f"not_followed_{cause}_ratio": self.share(n) for (_, cause), n in rising}
        return {"not_followed_ratio": self.share(self.num_missed), **worst}

    def words(self) -> str:
        """The share and its most frequent causes, for the check of a take."""
        causes = ", ".join(
            f"{finger} {WORDS[cause]} {_percent(self.share(num))}"
            for (finger, cause), num in self.causes.most_common(MAX_NAMED)
        )
        share = _percent(self.share(self.num_missed))
        return f"the robot's hand could not follow {share} of the time: {causes}"


class _Hand:
    """One stream of keypoints; `newest` is written by its reader, all else by the thread."""

    def __init__(self, side: Side, period_ns: int) -> None:
        self._side: Side = side
        self._period_ns = period_ns
        self.newest: Sample | None = None
        # Replaced as a whole, never changed: whoever reads it needs no lock.
        self.counts = FollowCounts()
        self.note = LOADING
        self._check: FollowCheck | None = None
        self._before_ns: int | None = None
        # When the hand began not to be followed, and when each cause was last found.
        self._since_ns = self._until_ns = -HOLD_NS
        self._found: dict[str, tuple[FollowCause, int]] = {}

    def look(self, make: MakeFollowCheck, calibration: Mapping[str, Matrix]) -> None:
        """Check the newest sample, if it is new."""
        if self._check is None:
            if self.note != LOADING:
                return  # It could not be made, and nothing changes that.
            self._check = make(self._side, calibration)
        sample, before_ns = self.newest, self._before_ns
        if sample is None or (before_ns is not None and sample.t_host_ns <= before_ns):
            return
        self._before_ns = now_ns = sample.t_host_ns
        period_ns = self._period_ns if before_ns is None else now_ns - before_ns
        causes = self._check(sample.values, period_ns / 1e9)
        if causes is None:
            return
        self.note = ""
        self.counts = self.counts.plus(causes)
        if causes:
            if now_ns - self._until_ns > HOLD_NS:
                self._since_ns = now_ns
            self._until_ns = now_ns
            self._found = self._found | {f: (cause, now_ns) for f, cause in causes.items()}

    def live(self, now_ns: int) -> RobotFollowing | None:
        """What is known at a moment; None while no samples come."""
        sample, found = self.newest, self._found
        if sample is None or now_ns - sample.t_host_ns > MAX_AGE_NS:
            return None
        if self.note:
            return RobotFollowing(level="STALE", message=self.note)
        fingers = {f: cause for f, (cause, t_ns) in found.items() if now_ns - t_ns <= HOLD_NS}
        if not fingers:
            return RobotFollowing(level="OK", message="robot follows")
        return RobotFollowing(
            level="WARN",
            message=f"robot cannot follow: {_by_cause(fingers)}",
            fingers=fingers,
            lasted_s=max(0, self._until_ns - self._since_ns) / 1e9,
        )


class FollowWatch:
    """Checks the tracked hands of a station 30 times a second at most.

    Those of keypoints with a side are checked; without `make` none is.
    """

    def __init__(
        self,
        descriptors: Sequence[StreamDescriptor],
        calibration: Mapping[str, Matrix],
        make: MakeFollowCheck | None,
        *,
        clock: StationClock,
    ) -> None:
        self._hands = {
            d.name: _Hand(d.side, d.period_ns())
            for d in descriptors
            if make is not None and d.kind == "keypoints" and d.side is not None
        }
        self._make = make
        self._calibration = calibration
        self._looks = PeriodicCall(self.look, period_ns=PERIOD_NS, clock=clock, name="follow")

    def start(self) -> None:
        """Start checking, if there is a hand to check."""
        if self._hands:
            self._looks.start()

    def stop(self) -> None:
        """End the thread; what it loads or checks at this moment is not waited for."""
        self._looks.cancel()

    def accept(self, readings: Readings) -> None:
        """Remember the newest sample of a hand (called by the reader threads)."""
        for name, samples in readings.items():
            if name in self._hands:
                self._hands[name].newest = samples[-1]

    def look(self) -> None:
        """Check each hand once."""
        for name, hand in self._hands.items():
            try:
                if self._make is not None:
                    hand.look(self._make, self._calibration)
            except DexTouchError as error:
                if hand.note != (note := f"robot's hand not checked: {error.message}"):
                    logger.warning("refuse_follow_check", stream=name, error=error.message)
                hand.note = note
            except Exception:
                # A check that fails must not end those of the other hand.
                if hand.note in {"", LOADING}:
                    logger.exception("fail_follow_check", stream=name)
                hand.note = "robot's hand not checked: the check failed, see the station's log"

    def counts(self) -> dict[str, FollowCounts]:
        """Checks since the station's start, by stream."""
        return {name: hand.counts for name, hand in self._hands.items()}

    def live(self, stream: str, now_ns: int) -> RobotFollowing | None:
        """Whether the robot's hand can follow now; None of streams that are not checked."""
        hand = self._hands.get(stream)
        return None if hand is None else hand.live(now_ns)


def _percent(share: float) -> str:
    return f"{share * 100:.0f} %"


def _by_cause(fingers: Mapping[str, FollowCause]) -> str:
    """Fingers and causes in words, such as "index, middle at the joint limit · thumb too fast"."""
    return " · ".join(
        f"{', '.join(named)} {words}"
        for cause, words in WORDS.items()
        if (named := [finger for finger, other in fingers.items() if other == cause])
    )
