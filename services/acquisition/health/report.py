"""Health report of a station: the current state of each stream and device.

Silent streams are detected here, for every report; a silent stream has no figures.
"""

from collections.abc import Mapping, Sequence

from dextouch.streams import StreamDescriptor
from services.acquisition.health.codes import CODES, StaleCode
from services.acquisition.health.levels import worst
from services.acquisition.health.schemas import DeviceHealth, RaisedFinding, StreamHealth
from services.acquisition.supervisor import DeviceSupervisor

STALE_AFTER_NS = {"image": 500_000_000}
STALE_AFTER_OTHERS_NS = 200_000_000
LATE_PERIODS = round(CODES["late"].warn)


def stale_after_ns(descriptor: StreamDescriptor) -> int:
    """Age from which a stream is stale; a slow stream has 3 of its periods at least."""
    limit_ns = STALE_AFTER_NS.get(descriptor.kind, STALE_AFTER_OTHERS_NS)
    return max(limit_ns, LATE_PERIODS * descriptor.period_ns())


def stale_code(
    supervisor: DeviceSupervisor, descriptor: StreamDescriptor, now_ns: int
) -> StaleCode | None:
    """Why a stream is stale, None when it is not.

    "unplugged" when the device is not open, "silent" when it is and nothing comes.
    """
    if not supervisor.connected.is_set():
        return "unplugged"
    last_ns = supervisor.streams[descriptor.name].last_t_host_ns
    if last_ns is None or now_ns - last_ns > stale_after_ns(descriptor):
        return "silent"
    return None


def stream_health(
    supervisor: DeviceSupervisor,
    descriptor: StreamDescriptor,
    now_ns: int,
    *,
    findings: Sequence[RaisedFinding],
    figures: Mapping[str, float],
) -> StreamHealth:
    """One stream at this moment."""
    stream, statistics = supervisor.streams[descriptor.name], supervisor.driver.statistics
    age_ns = None
    if stream.last_t_host_ns is not None:
        age_ns = max(0, now_ns - stream.last_t_host_ns)
    stale = stale_code(supervisor, descriptor, now_ns)
    if stale is not None:
        text = _words(supervisor, stale, age_ns)
        is_stale = RaisedFinding.since(stale, "STALE", text, lasted_ns=age_ns)
        findings, figures = (is_stale, *findings), {}
    elif not findings and age_ns is not None and age_ns > LATE_PERIODS * descriptor.period_ns():
        findings = (RaisedFinding.since("late", "WARN", "late", lasted_ns=age_ns),)
    skew, residual_s = figures.get("clock_skew_ratio"), figures.get("clock_residual_p95_seconds")
    return StreamHealth(
        stream=descriptor.name,
        device=supervisor.driver.name,
        hand=descriptor.side,
        level=worst([finding.level for finding in findings]),
        stale=stale,
        reasons=tuple(finding.message for finding in findings),
        findings=tuple(findings),
        figures=dict(figures),
        rate_hz=figures.get("rate_hz"),
        nominal_rate_hz=descriptor.nominal_rate_hz,
        age_s=None if age_ns is None else age_ns / 1e9,
        num_samples=stream.num_samples,
        received=statistics.packets,
        lost=statistics.lost,
        skew_ppm=None if skew is None else skew * 1e6,
        clock_residual_ms=None if residual_s is None else residual_s * 1e3,
    )


def device_health(supervisor: DeviceSupervisor) -> DeviceHealth:
    """A device's counters."""
    driver, events = supervisor.driver, supervisor.events()
    sides = {descriptor.side for descriptor in driver.descriptors}
    return DeviceHealth.model_validate(
        {
            **{name: events[name] for name in DeviceHealth.model_fields if name in events},
            "device": driver.name,
            "hand": sides.pop() if len(sides) == 1 else None,
            "connected": supervisor.connected.is_set(),
            "address": str(driver.info),
            "queue_dropped": events.get("queue", 0),
            "reconnects": supervisor.reconnects,
            "failures": events["driver_failure"],
            "last_error": supervisor.last_error,
        }
    )


def _words(supervisor: DeviceSupervisor, stale: StaleCode, age_ns: int | None) -> str:
    if supervisor.last_error is not None:
        return supervisor.last_error
    if stale == "unplugged":
        return "not connected"
    return "no data yet" if age_ns is None else f"no data for {age_ns * 1e-9:.1f} s"
