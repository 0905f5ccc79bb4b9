"""Root causes behind a station's findings: one cause with one advice for everything it explains.

Causes are sought from the widest to the narrowest, and each takes the findings that it explains;
what remains is a device's own fault.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Final

from dextouch.schemas import (
    CauseCode,
    DeviceHealth,
    HealthCause,
    HealthLevel,
    RaisedFinding,
    StreamHealth,
)
from services.acquisition.health.codes import CAUSES, CODES, SEVERITY
from services.acquisition.health.evaluation import worst

# What a computer does to streams that it does not read in time.
HOST_CODES: Final = frozenset(
    {"late", "rate", "loss", "queue", "jitter", "latency", "gap", "clock_residual", "image_gap"}
    | {"silent"}
)
# Findings of the station itself that tell of its computer; a sleep explains also a late wake.
HOST_FINDINGS: Final = ("host_suspended", "overload")
# Delays and losses that arise after the read, in this computer alone.
INSIDE_CODES: Final = frozenset({"latency", "queue"})
MIN_HOST_DEVICES = 3
HOST_SHARE = 0.5
# A computer with a processor to spare is not why devices are late.
BUSY_RATIO = 0.9
# A busy computer reads nothing for a moment; a stream that is silent for longer has another cause.
BRIEF_SILENCE_S = 2.0
GONE_CODES: Final = frozenset({"unplugged", "silent"})
LINK_CODES: Final = frozenset(
    {"late", "rate", "loss", "damage", "jitter", "gap", "clock_residual", "image_gap"}
    | {"reconnect", "silent", "unplugged"}
)
CLOCK_CODES: Final = frozenset({"clock_step", "clock_skew", "clock_residual", "restart"})
MIN_SHARED_DEVICES = 2
# Of a simulated device there is nothing to plug or to replace.
SIMULATED_ADVICE: Final = (
    "This device is simulated: a fault button of the Station page (Unplug: key F), its fault "
    "script or the load of this computer causes it."
)
_ORDER: Final = tuple(CAUSES)
Explained = list[tuple[StreamHealth, RaisedFinding]]


class _Unexplained:
    """Findings that no cause explains yet, by stream."""

    def __init__(self, streams: Sequence[StreamHealth]) -> None:
        self.streams = streams
        self._left = {stream.stream: list(stream.findings) for stream in streams}

    def of(self, stream: StreamHealth) -> Sequence[RaisedFinding]:
        return self._left[stream.stream]

    def take(
        self, streams: Sequence[StreamHealth], belongs: Callable[[RaisedFinding], bool]
    ) -> Explained:
        """Remove and give the findings that belong to a cause."""
        taken = []
        for stream in streams:
            found = [finding for finding in self._left[stream.stream] if belongs(finding)]
            self._left[stream.stream] = [f for f in self._left[stream.stream] if f not in found]
            taken += [(stream, finding) for finding in found]
        return taken

    def devices(self, codes: Collection[str]) -> dict[str, list[StreamHealth]]:
        """Streams by device that still have one of these codes."""
        found: dict[str, list[StreamHealth]] = {}
        for stream in self.streams:
            if any(finding.code in codes for finding in self.of(stream)):
                found.setdefault(stream.device, []).append(stream)
        return found


def find_causes(
    streams: Sequence[StreamHealth],
    devices: Sequence[DeviceHealth],
    findings: Sequence[RaisedFinding],
    cpu_ratio: float = 0.0,
) -> tuple[HealthCause, ...]:
    """Why the station is not well, widest and gravest cause first.

    `cpu_ratio` is the share of the processors' time that was used in the last 10 s.
    """
    left = _Unexplained(streams)
    known = {device.device: device for device in devices}
    causes = [
        *_shared(left, known, GONE_CODES),
        *_gone(left, known),
        *_host(left, findings, cpu_ratio),
        *_shared(left, known, LINK_CODES),
        *_clocks(left, known),
        *_own(left, known),
        *(
            _cause("station", f.code, f.message, [], [f], advice=f.advice)
            for f in findings
            if f.code not in HOST_FINDINGS
        ),
    ]
    return tuple(
        sorted(causes, key=lambda cause: (_ORDER.index(cause.code), -SEVERITY.index(cause.level)))
    )


def _host(
    left: _Unexplained, findings: Sequence[RaisedFinding], cpu_ratio: float
) -> Iterator[HealthCause]:
    """The computer itself: it slept, its threads wake late, or it is late for most devices."""
    own = [f for code in HOST_FINDINGS for f in findings if f.code == code]
    if own:
        what = "slept" if own[0].code == "host_suspended" else "is overloaded"
        why, advice = own[0].message, own[0].advice
    else:
        open_streams = [s for s in left.streams if s.stale != "unplugged"]
        enough = max(MIN_HOST_DEVICES, HOST_SHARE * len({s.device for s in open_streams}))
        what, advice = "is overloaded", ""
        late = {s.device for s in open_streams if any(_is_of_host(f) for f in left.of(s))}
        if (num_delayed := len(left.devices(INSIDE_CODES))) >= enough:
            why = f"{num_delayed} devices are delayed after the read"
        elif cpu_ratio >= BUSY_RATIO and len(late) >= enough:
            why = f"processors {100 * cpu_ratio:.0f} % busy, {len(late)} devices late"
        else:
            return
    explained = left.take(left.streams, _is_of_host)
    yield _cause("host", "", f"This computer {what}: {why}", explained, own, advice=advice)


def _is_of_host(finding: RaisedFinding) -> bool:
    if finding.code == "silent":
        return finding.lasted_s is not None and finding.lasted_s < BRIEF_SILENCE_S
    return finding.code in HOST_CODES


def _shared(
    left: _Unexplained, known: Mapping[str, DeviceHealth], codes: Collection[str]
) -> Iterator[HealthCause]:
    """What several devices share, where all of them have one of these codes."""
    groups: dict[tuple[CauseCode, str], list[str]] = {}
    for device in known.values():
        if device.shares is not None:
            groups.setdefault((device.shares.kind, device.shares.name), []).append(device.device)
    for (kind, name), members in groups.items():
        affected = left.devices(codes)
        if len(members) < MIN_SHARED_DEVICES or not set(members) <= affected.keys():
            continue
        streams = [stream for member in members for stream in affected[member]]
        is_gone = codes is GONE_CODES
        # Of a device that is gone all the rest follows.
        explained = left.take(streams, lambda f, gone=is_gone: gone or f.code in LINK_CODES)  # type: ignore[misc]
        what = "nothing comes from" if is_gone else "data is lost or late of"
        text = f"{CAUSES[kind].title} {name}: {what} {', '.join(members)}"
        is_simulated = all(known[member].simulated for member in members)
        advice = SIMULATED_ADVICE if is_simulated else ""
        yield _cause(kind, name, text, explained, advice=advice)


def _gone(left: _Unexplained, known: Mapping[str, DeviceHealth]) -> Iterator[HealthCause]:
    """Single devices that are not open, or silent for longer than a busy computer explains."""
    for device, streams in left.devices(GONE_CODES).items():
        gone = [f for s in streams for f in left.of(s) if f.code in GONE_CODES]
        if all(_is_of_host(finding) for finding in gone):
            continue
        explained = left.take(streams, lambda _: True)
        yield _of_device("gone", device, gone[0], explained, known)


def _clocks(left: _Unexplained, known: Mapping[str, DeviceHealth]) -> Iterator[HealthCause]:
    for device, streams in left.devices({"clock_step"}).items():
        explained = left.take(streams, lambda finding: finding.code in CLOCK_CODES)
        step = next(finding for _, finding in explained if finding.code == "clock_step")
        yield _of_device("clock", device, step, explained, known)


def _own(left: _Unexplained, known: Mapping[str, DeviceHealth]) -> Iterator[HealthCause]:
    """Whatever else a device has, led by its gravest finding."""
    for device, streams in left.devices(CODES).items():
        explained = left.take(streams, lambda _: True)
        gravest = max((f for _, f in explained), key=lambda f: SEVERITY.index(f.level))
        yield _of_device("device", device, gravest, explained, known)


def _of_device(
    code: CauseCode,
    device: str,
    leading: RaisedFinding,
    explained: Explained,
    known: Mapping[str, DeviceHealth],
) -> HealthCause:
    is_simulated = device in known and known[device].simulated
    advice = SIMULATED_ADVICE if is_simulated else leading.advice
    return _cause(code, device, f"{device}: {leading.message}", explained, advice=advice)


def _cause(
    code: CauseCode,
    subject: str,
    message: str,
    explained: Explained,
    others: Sequence[RaisedFinding] = (),
    *,
    advice: str = "",
) -> HealthCause:
    findings = [*(finding for _, finding in explained), *others]
    lasted_s = [finding.lasted_s for finding in findings if finding.lasted_s is not None]
    levels: list[HealthLevel] = [finding.level for finding in findings]
    return HealthCause(
        code=code,
        subject=subject,
        level=worst(levels),
        message=message,
        advice=advice or CAUSES[code].advice,
        lasted_s=max(lasted_s, default=None),
        streams=tuple(dict.fromkeys(stream.stream for stream, _ in explained)),
        findings=tuple(dict.fromkeys(finding.code for finding in findings)),
    )
