"""Health checks of values: jumps and jitter of poses, numbers that are missing, bad images."""

import numpy as np

from dextouch.streams import StreamDescriptor
from services.acquisition.drivers.base import Driver
from services.acquisition.health.levels import Finding, Verdict, find
from services.acquisition.health.samples import WINDOW_NS, Block, Rolling

MAX_SPEED_M_S = 5.0
REST_SPEED_M_S = 0.02
REST_NS = 1_000_000_000
MIN_REST_SAMPLES = 40


class PoseJudge:
    """Judges the poses of one body: jumps that came through, and its trembling at rest."""

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._descriptor = descriptor
        self._last: tuple[int, np.ndarray] | None = None
        self._jumps = Rolling(WINDOW_NS)
        self._rest_ns = np.empty(0, dtype=np.int64)
        self._rest_m = np.empty((0, 3))

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        if block.values is None or not len(block):
            return Verdict()
        times_ns = block.t_device_ns
        if not self._descriptor.capabilities.device_time or times_ns.min() < 0:
            times_ns = block.t_host_ns
        positions_m = block.values[:, :3].astype(np.float64)
        share = self._jumped_share(times_ns, positions_m, block.t_host_ns, now_ns)
        text = f"{share:.1%} of its steps are faster than {MAX_SPEED_M_S:g} m/s"
        findings = find("jump", share, text)
        figures: dict[str, float] = {}
        jitter_m = self._jitter_m(times_ns, positions_m)
        if jitter_m is not None:
            figures["stationary_jitter_meters"] = jitter_m
            text = f"jitters by {jitter_m * 1e3:.1f} mm at rest"
            findings += find("pose_jitter", jitter_m, text)
        return Verdict(findings, figures)

    def _jumped_share(
        self, times_ns: np.ndarray, positions_m: np.ndarray, t_host_ns: np.ndarray, now_ns: int
    ) -> float:
        when, steps_ns = t_host_ns[1:], np.diff(times_ns)
        steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
        if self._last is not None:
            when = t_host_ns
            steps_ns = np.concatenate([[times_ns[0] - self._last[0]], steps_ns])
            first_m = np.linalg.norm(positions_m[0] - self._last[1])
            steps_m = np.concatenate([[first_m], steps_m])
        self._last = (int(times_ns[-1]), positions_m[-1])
        # A step back of the clock says nothing about speed.
        jumped = (steps_ns > 0) & (steps_m > MAX_SPEED_M_S * steps_ns * 1e-9)
        shares = self._jumps.add(when, jumped, now_ns)
        return float(shares.mean()) if len(shares) else 0.0

    def _jitter_m(self, times_ns: np.ndarray, positions_m: np.ndarray) -> float | None:
        """RMS about a parabola through the last second; None unless the body rests."""
        all_ns = np.concatenate([self._rest_ns, times_ns])
        all_m = np.concatenate([self._rest_m, positions_m])
        kept = (all_ns >= all_ns[-1] - REST_NS) & (all_ns <= all_ns[-1])
        self._rest_ns, self._rest_m = all_ns[kept], all_m[kept]
        if len(self._rest_ns) < MIN_REST_SAMPLES:
            return None
        t_s = (self._rest_ns - self._rest_ns[-1]) * 1e-9
        basis = np.stack([np.ones_like(t_s), t_s, t_s**2], axis=1)
        fitted, *_ = np.linalg.lstsq(basis, self._rest_m, rcond=None)
        speeds_m_s = np.linalg.norm(fitted[1] + 2 * t_s[:, None] * fitted[2], axis=1)
        if speeds_m_s.mean() > REST_SPEED_M_S:
            return None
        errors_m = self._rest_m - basis @ fitted
        return float(np.sqrt((errors_m**2).sum(axis=1).mean()))


class FiniteJudge:
    """Checks the share of a stream's values that is missing (NaN): nodes not seen, broken cells.

    What never held a number is no part of the device (a glove model's empty cells).
    """

    def __init__(self, code: str, word: str) -> None:
        self._code, self._word = code, word
        self._shares = Rolling(WINDOW_NS)
        self._ever: np.ndarray | None = None

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        if block.values is None or not len(block) or block.values.dtype.kind != "f":
            return Verdict()
        finite = np.isfinite(block.values.reshape(len(block), -1))
        ever = finite.any(axis=0) if self._ever is None else self._ever | finite.any(axis=0)
        self._ever = ever
        shares = 1.0 - finite[:, ever].mean(axis=1) if ever.any() else np.ones(len(block))
        ratio = float(self._shares.add(block.t_host_ns, shares, now_ns).mean())
        text = f"{ratio:.1%} of the {self._word}"
        return Verdict(find(self._code, ratio, text), {"missing_ratio": ratio})


class CameraJudge:
    """Judges one camera: anything is a warning, and an error after a second."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._since_ns: dict[str, int] = {}

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        del block
        quality = self._driver.quality
        if quality is None:
            return Verdict()
        clipped = quality.clipped_ratio
        flags = {
            "image_frozen": (quality.frozen, "the same image repeatedly"),
            "image_blurred": (quality.blurred, "much less sharp than usual"),
            "image_gap": (quality.gap, "images are missing according to its timestamps"),
            "image_clipped": (quality.clipped, f"{clipped:.0%} of the image black or white"),
        }
        self._since_ns = {
            code: self._since_ns.get(code, now_ns) for code, (is_bad, _) in flags.items() if is_bad
        }
        findings: tuple[Finding, ...] = ()
        for code, since_ns in self._since_ns.items():
            # What has only begun has lasted for more than nothing.
            findings += find(code, max(1, now_ns - since_ns) / 1e9, flags[code][1])
        figures = {
            "image_clipped_ratio": clipped,
            "image_frozen": float(quality.frozen),
            "image_blurred": float(quality.blurred),
        }
        return Verdict(findings, figures)
