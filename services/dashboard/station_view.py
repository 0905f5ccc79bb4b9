"""Panels of devices and recorder: the station's answers in the page's words and display units."""

from collections.abc import Sequence

from dextouch.frozen_model import FrozenModel
from dextouch.schemas import (
    DeviceHealth,
    HealthLevel,
    RecorderStatus,
    StationHealth,
    StreamHealth,
    TakePrompt,
)

# From harmless to grave: an ERROR of one stream outranks the silence of another.
LEVELS: tuple[HealthLevel, ...] = ("OK", "WARN", "STALE", "ERROR")


class StreamView(FrozenModel):
    """One row of the device table; None where not measured.

    `advice` refers to the most severe problem in `message`, which has lasted for `lasted_s`.
    """

    name: str
    device: str
    level: HealthLevel
    message: str
    advice: str
    lasted_s: float | None
    rate_hz: float | None
    nominal_rate_hz: float
    dropped: int
    drop_percent: float | None
    age_s: float | None
    skew_ppm: float | None
    clock_error_ms: float | None


class RecorderView(FrozenModel):
    """State of the recorder and its available actions.

    `note` summarizes the check of the take, `problems` lists its findings, worst first.
    """

    state: str
    actions: tuple[str, ...] = ()
    recording_id: str | None = None
    prompt: TakePrompt | None = None
    elapsed_s: float | None = None
    level: HealthLevel = "OK"
    complete: bool = True
    note: str = ""
    problems: tuple[str, ...] = ()


class StationView(FrozenModel):
    """Overview of the station; by default of one that does not respond, for the reason `note`."""

    reachable: bool = False
    level: HealthLevel = "ERROR"
    summary: str = "acquisition does not respond"
    note: str
    note_level: HealthLevel = "ERROR"
    streams: tuple[StreamView, ...] = ()
    recorder: RecorderView = RecorderView(state="unknown", level="ERROR")


def station_view(station: StationHealth, recorder: RecorderStatus) -> StationView:
    """The station view of an acquisition service that responds."""
    devices = {device.device: device for device in station.devices}
    streams = tuple(_stream_view(item, devices.get(item.device)) for item in station.streams)
    found: list[HealthLevel] = [finding.level for finding in station.findings]
    notes = [f"{finding.message} → {finding.advice}" for finding in station.findings]
    if not streams:
        found, notes = ["STALE", *found], ["No devices are connected.", *notes]
    return StationView(
        reachable=True,
        level=_worst([*(stream.level for stream in streams), *found]),
        summary=_summary(streams),
        note=" · ".join(notes),
        note_level=_worst(found),
        streams=streams,
        recorder=recorder_view(recorder),
    )


def recorder_view(recorder: RecorderStatus) -> RecorderView:
    """The recorder view, with the findings of a take's check among the recorder's problems."""
    check = recorder.check
    # ERROR sorts before WARN. The recorder repeats what the check found: each is listed once.
    found = sorted(check.problems, key=lambda problem: problem.level) if check else []
    checked = [problem.message for problem in found]
    own = [message for message in recorder.problems if message not in checked]
    problems = tuple(dict.fromkeys([*own, *checked]))
    complete = check is None or check.complete
    words = [recorder.recording_id] if recorder.recording_id else []
    if check is not None:
        words.append("complete" if complete else "incomplete")
    if problems:
        words.append("1 finding" if len(problems) == 1 else f"{len(problems)} findings")
    level: HealthLevel = "WARN" if complete else "ERROR"
    return RecorderView(
        state=recorder.state,
        actions=recorder.actions,
        recording_id=recorder.recording_id,
        prompt=recorder.prompt,
        elapsed_s=recorder.duration_s,
        level=level if problems else "OK",
        complete=complete,
        note=" · ".join(words),
        problems=problems,
    )


def _worst(levels: Sequence[HealthLevel]) -> HealthLevel:
    return max(levels, key=LEVELS.index, default="OK")


def _stream_view(item: StreamHealth, device: DeviceHealth | None) -> StreamView:
    words = [finding.message for finding in item.findings]
    first = item.findings[0] if item.findings else None
    if device is not None:
        words += [f"{device.reconnects} reconnects"] * bool(device.reconnects)
        words += [f"{device.suspects} packets held back"] * bool(device.suspects)
        if device.last_error and item.level in {"ERROR", "STALE"}:
            words.append(device.last_error)
    offered = item.received + item.lost
    return StreamView(
        name=item.stream,
        device=item.device,
        level=item.level,
        message=" · ".join(dict.fromkeys(words)),
        advice=first.advice if first else "",
        lasted_s=first.lasted_s if first else None,
        rate_hz=item.rate_hz,
        nominal_rate_hz=item.nominal_rate_hz,
        dropped=item.lost,
        drop_percent=100 * item.lost / offered if offered else None,
        age_s=item.age_s,
        skew_ppm=item.skew_ppm,
        clock_error_ms=item.clock_residual_ms,
    )


def _summary(streams: Sequence[StreamView]) -> str:
    """Number of streams at each level, and the devices with problems."""
    parts = []
    for level in ("ERROR", "STALE", "WARN", "OK"):
        devices = [stream.device for stream in streams if stream.level == level]
        names = "" if level == "OK" else f" ({', '.join(dict.fromkeys(devices))})"
        if devices:
            parts.append(f"{len(devices)} {level}{names}")
    return " · ".join(parts) or "no streams"
