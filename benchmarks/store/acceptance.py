"""Requirements on the store, with measured values and verdicts."""

from collections.abc import Mapping, Sequence

from benchmarks.figures import Requirement
from benchmarks.store.appends import SPOOL, SPOOL_SYNCED, AppendResult
from benchmarks.store.compare import DesignResult
from benchmarks.store.live import SPEED, LiveResult

# The default configuration that requirements refer to, and the design compared with.
OURS, RIVAL = "ours-h264", "zarr-jpeg"


def requirements(
    results: Mapping[str, DesignResult],
    appends: Sequence[AppendResult],
    live: Sequence[LiveResult],
) -> list[Requirement]:
    """Build the table of requirements; some may be unmeasured in this run."""
    ours, rival = results.get(OURS), results.get(RIVAL)
    return [
        *_against_rival(ours, rival),
        Requirement(
            "processor seconds of writing a recorded second",
            None if ours is None else ours.cpu_s.median / ours.seconds,
            "at most",
            0.35,
            "s",
        ),
        Requirement(
            f"rows late or dropped, station live at {SPEED:g} times real time",
            float(max(run.num_untimely for run in live)) if live else None,
            "at most",
            0.0,
        ),
        _append("numeric append, p99", SPOOL, appends, bound_ms=0.1),
        _append("numeric append on the disk, p99", SPOOL_SYNCED, appends, bound_ms=1.0),
        Requirement(
            "34 samples of both gloves at native rate",
            None if ours is None or ours.touch_ms is None else ours.touch_ms.median,
            "at most",
            0.4,
            "ms",
        ),
    ]


def _against_rival(ours: DesignResult | None, rival: DesignResult | None) -> list[Requirement]:
    write = bytes_ = decibels = windows = None
    if ours is not None and rival is not None:
        write = rival.write_s.over(ours.write_s).median
        bytes_ = ours.num_bytes / rival.num_bytes
        decibels = rival.mean_psnr_db - ours.mean_psnr_db
        windows = rival.window_ms.over(ours.window_ms).median
    return [
        Requirement(f"write speed, times {RIVAL}", write, "at least", 2.0),
        Requirement(f"bytes, times {RIVAL}", bytes_, "at most", 0.2),
        Requirement(f"mean PSNR below {RIVAL}", decibels, "at most", 2.0, "dB"),
        Requirement(f"one-camera windows a second, times {RIVAL}", windows, "at least", 1.8),
    ]


def _append(
    what: str, way: str, appends: Sequence[AppendResult], *, bound_ms: float
) -> Requirement:
    found = [append.p99_ms.median for append in appends if append.name == way]
    return Requirement(what, found[0] if found else None, "at most", bound_ms, "ms")
