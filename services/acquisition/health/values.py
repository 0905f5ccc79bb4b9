"""Health checks of values: jumps and jitter of poses, numbers that are missing, bad images."""

import numpy as np

from dextouch.streams import StreamDescriptor
from services.acquisition.drivers.base import Driver
from services.acquisition.health.evaluation import Evaluation, Rolling

MAX_SPEED_M_S = 5.0
REST_SPEED_M_S = 0.02
REST_NS = 1_000_000_000
MIN_REST_SAMPLES = 40


class PoseJudge:
    """Judges the poses of one body: jumps that came through, and its trembling at rest."""

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self._descriptor = descriptor
        self._jumps = Rolling()
        # The last second, by the device's clock where it has one.
        self._t_ns = np.empty(0, dtype=np.int64)
        self._positions_m = np.empty((0, 3))

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        block = evaluation.block
        if block.values is None or not len(block):
            return
        times_ns = block.t_device_ns
        if not self._descriptor.capabilities.device_time or times_ns.min() < 0:
            times_ns = block.t_host_ns
        t_ns = np.concatenate([self._t_ns, times_ns])
        positions_m = np.concatenate([self._positions_m, block.values[:, :3].astype(np.float64)])
        steps_s = np.diff(t_ns)[-len(block) :] * 1e-9
        steps_m = np.linalg.norm(np.diff(positions_m, axis=0)[-len(block) :], axis=1)
        # A step back of the clock says nothing about speed.
        jumped = (steps_s > 0) & (steps_m > MAX_SPEED_M_S * steps_s)
        when_ns = block.t_host_ns[len(block) - len(jumped) :]
        shares = self._jumps.add(when_ns, jumped, evaluation.now_ns)
        share = float(shares.mean()) if len(shares) else 0.0
        text = f"{share:.1%} of its steps are faster than {MAX_SPEED_M_S:g} m/s"
        evaluation.judge("jump", share, text)
        kept = (t_ns >= t_ns[-1] - REST_NS) & (t_ns <= t_ns[-1])
        self._t_ns, self._positions_m = t_ns[kept], positions_m[kept]
        jitter_m = self._jitter_m()
        if jitter_m is not None:
            evaluation.figures["stationary_jitter_meters"] = jitter_m
            text = f"jitters by {jitter_m * 1e3:.1f} mm at rest"
            evaluation.judge("pose_jitter", jitter_m, text)

    def _jitter_m(self) -> float | None:
        """RMS about a parabola through the last second; None unless the body rests."""
        if len(self._t_ns) < MIN_REST_SAMPLES:
            return None
        t_s = (self._t_ns - self._t_ns[-1]) * 1e-9
        basis = np.vander(t_s, 3, increasing=True)
        fitted, *_ = np.linalg.lstsq(basis, self._positions_m, rcond=None)
        speeds_m_s = np.linalg.norm(fitted[1] + 2 * t_s[:, None] * fitted[2], axis=1)
        if speeds_m_s.mean() > REST_SPEED_M_S:
            return None
        errors_m = self._positions_m - basis @ fitted
        return float(np.sqrt((errors_m**2).sum(axis=1).mean()))


class FiniteJudge:
    """Checks the share of a stream's values that is missing (NaN): nodes not seen, broken cells.

    What never held a number is no part of the device (a glove model's empty cells).
    """

    def __init__(self, code: str, word: str) -> None:
        self._code, self._word = code, word
        self._shares = Rolling()
        self._ever = np.zeros(1, dtype=np.bool_)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        block = evaluation.block
        if block.values is None or not len(block) or block.values.dtype.kind != "f":
            return
        finite = np.isfinite(block.values.reshape(len(block), -1))
        ever = self._ever = self._ever | finite.any(axis=0)
        shares = 1.0 - finite[:, ever].mean(axis=1) if ever.any() else np.ones(len(block))
        ratio = float(self._shares.add(block.t_host_ns, shares, evaluation.now_ns).mean())
        evaluation.figures["missing_ratio"] = ratio
        evaluation.judge(self._code, ratio, f"{ratio:.1%} of the {self._word}")


class CameraJudge:
    """Judges one camera: anything is a warning, and an error after a second."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._since_ns: dict[str, int] = {}

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        quality, now_ns = self._driver.quality, evaluation.now_ns
        if quality is None:
            return
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
        for code, since_ns in self._since_ns.items():
            # What has only begun has lasted for more than nothing.
            evaluation.judge(code, max(1, now_ns - since_ns) / 1e9, flags[code][1])
        evaluation.figures |= {
            "image_clipped_ratio": clipped,
            "image_frozen": float(quality.frozen),
            "image_blurred": float(quality.blurred),
        }
