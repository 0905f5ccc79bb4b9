"""Table of all health codes: what each one means, its limits, and what an operator can do.

docs/health.md holds it as `table` shows it, and the root causes as `cause_table` does.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from dextouch.schemas import CauseCode, HealthLevel
from dextouch.streams import RATE_ERROR, RATE_WARN, RESIDUAL_ERROR_S, RESIDUAL_WARN_S

SEVERITY: tuple[HealthLevel, ...] = ("OK", "WARN", "ERROR", "STALE")
NEVER = math.inf
# How a limit is shown: the factor that makes a number of this unit.
_SHOWN_AS: Final = {"%": 100.0, "mm": 1e3, "ms": 1e3, "min left": -1 / 60, "days": 1 / 86_400}


@dataclass(frozen=True)
class Rule:
    """What raises a code.

    Attributes:
        warn: a WARN above this limit; 0 is any at all.
        error: an ERROR from this limit on, if it is above the first one, too.
        unit: in which the limits are shown; they are shares, seconds and metres themselves.
        window: what a value is taken over.
        meaning: what the value is.
        advice: one line for operators.
    """

    warn: float
    error: float
    unit: str
    window: str
    meaning: str
    advice: str


# fmt: off
CODES: Final[Mapping[str, Rule]] = {
    "unplugged": Rule(NEVER, NEVER, "", "now", "the device is not open: STALE at once",
        "Check plug, cable and power; the station reconnects automatically."),
    "silent": Rule(NEVER, NEVER, "", "now", "open, but nothing comes: STALE at once",
        "Power-cycle the device; if it stays silent, try another cable or port."),
    "late": Rule(3.0, NEVER, "periods", "now", "age of the newest sample, if all else is OK",
        "Wait a second; if it happens again, check the load of this computer."),
    "rate": Rule(RATE_WARN, RATE_ERROR, "%", "10 s", "deviation from the nominal rate",
        "Set the device to the rate that the station expects, and charge it."),
    "loss": Rule(0.001, 0.01, "%", "10 s", "packets lost by sequence number",
        "Move the receiver closer, or use another port without a hub."),
    "damage": Rule(0.001, 0.01, "%", "10 s", "wrong checksums and lengths; any skipped bytes",
        "Replace the cable and keep it away from motors and chargers."),
    "refused": Rule(0.001, 0.01, "%", "10 s", "packets without a valid sample",
        "Restart the device; if it continues, its firmware sends invalid readings."),
    "suspect": Rule(0.001, 0.01, "%", "10 s", "packets held back as implausible",
        "Check the cable and the port's baud rate; implausible packets are held back."),
    "queue": Rule(0.001, 0.01, "%", "10 s", "images dropped before encoding",
        "Close other programs, or set the camera to smaller or fewer images."),
    "repeated": Rule(0.0, NEVER, "", "10 s", "duplicate packets",
        "No data is lost; if it continues, use another port without a hub."),
    "reordered": Rule(0.0, NEVER, "", "10 s", "late packets, which are dropped",
        "Use a direct link; packets that arrive after newer ones are dropped."),
    "restart": Rule(0.0, NEVER, "", "10 s", "restarts of the device",
        "The device restarted; check its power supply and battery."),
    "reconnect": Rule(0.0, NEVER, "", "10 s", "times that the device was opened again",
        "Secure plug and cable, then record the take again."),
    "wrong_side": Rule(0.0, 0.0, "", "10 s", "packets of the other hand",
        "Swap the left and the right device, or their entries in the settings."),
    "wrong_version": Rule(0.0, 0.0, "", "10 s", "packets of another version",
        "Update the device's firmware, or this station."),
    "rejected": Rule(0.0, 0.0, "", "10 s", "the device is opened and rejected repeatedly",
        "Another kind of device responds; check port and protocol in the settings."),
    "jitter": Rule(2.0, 5.0, "periods", "10 s", "99th percentile of the interval between samples",
        "Close other programs and use a port without a hub."),
    "latency": Rule(2.0, 5.0, "periods", "10 s", "99th percentile of the time from read to spool",
        "Close other programs; this computer is too slow for the incoming data."),
    "gap": Rule(0.1, 0.5, "s", "10 s", "time without a sample, of 3 periods at least",
        "If it happened during a take, record it again; then check cable and hub."),
    "clock_skew": Rule(200.0, 1000.0, "ppm", "60 s", "skew between the clocks of device and host",
        "Let the device warm up; if it continues, its clock is faulty."),
    "clock_residual": Rule(RESIDUAL_WARN_S, RESIDUAL_ERROR_S, "ms", "10 s",
        "95 % of arrivals lie closer to their median",
        "Use a direct link; the latency of its packets varies too much."),
    "clock_step": Rule(0.0, 3.0, "", "1 h", "steps of the device's clock; one is shown for 60 s",
        "Record the take again; leave the device on between takes."),
    "clock_stamps": Rule(0.0, 0.0, "", "now", "samples without the timestamp that the device sends",
        "Restart the device; its packets have no timestamps."),
    "latency_calibration": Rule(5.0, NEVER, "sigma", "10 min", "path delay against calibration",
        "Calibrate the path latency again; cable, hub or firmware has changed."),
    "taxels_dead": Rule(0.0, 0.05, "%", "0.5 s", "taxels that read nothing; ERROR: a pad, a line",
        "Look for a broken wire or connector; replace the glove if it continues."),
    "taxels_stuck": Rule(0.0, 0.05, "%", "5 s", "taxels that keep one load; ERROR: a pad, a line",
        "Remove what presses there and flex the glove; replace it if it continues."),
    "taxels_saturated": Rule(0.0, 0.05, "%", "1 s", "taxels at full scale; ERROR: a pad, a line",
        "Release what presses there; if it continues, the cells are shorted."),
    "baseline": Rule(3.0, 10.0, "sigma", "0.5 s", "zero reading against the tare, hand at rest",
        "Open the hand, touch nothing, and tare the glove again."),
    "nan": Rule(0.01, 0.05, "%", "10 s", "tactile values that are NaN; any cell that becomes NaN",
        "Look for a broken wire or connector; restart the glove."),
    "tracking": Rule(0.01, 0.05, "%", "10 s", "not tracked, or nodes that are not visible",
        "Bring it back into view, clear the line of sight, and charge it."),
    "jump": Rule(0.0, 0.05, "%", "10 s", "steps faster than 5 m/s",
        "Cover mirrors and other light sources, and fix the base stations in place."),
    "frozen": Rule(0.0, 1.0, "s", "5 s", "time in which a device repeats the values it had",
        "Restart the device and its driver; check battery and line of sight."),
    "implausible": Rule(0.0, 0.05, "%", "5 s", "samples beyond limits; ERROR: another unit",
        "Correct unit and order of what the device or its bridge sends, as the message says."),
    "pose_jitter": Rule(1e-3, 5e-3, "mm", "1 s", "RMS of the position of a body at rest",
        "Fix tracker and base stations in place so that nothing vibrates."),
    "image_frozen": Rule(0.0, 1.0, "s", "now", "how long the same image comes again and again",
        "Reconnect the camera; it repeats the same image."),
    # No error: in the light of mains, cameras of 30 Hz see it pump.
    "image_content": Rule(0.0, NEVER, "s", "now", "how long images come that no camera takes",
        "Reconnect the camera and restart its bridge; check what else reads it, and the light."),
    "image_blurred": Rule(0.0, 1.0, "s", "now", "how long images are much less sharp than usual",
        "Clean the lens and adjust the focus."),
    "image_clipped": Rule(0.0, 1.0, "s", "now", "how long over 20 % of the image is black or white",
        "Adjust exposure or lighting, and make sure that nothing covers the lens."),
    "image_gap": Rule(0.0, 1.0, "s", "now", "how long the camera's timestamps lack images",
        "Connect the camera to a port of its own; it skips images."),
    "not_followed": Rule(0.05, NEVER, "%", "take", "time that the robot's hand could not follow",
        "Record it again slower, and within the joint limits of the robot's hand."),
    "disk": Rule(-1800.0, -300.0, "min left", "10 s", "time to a full disk at this data rate",
        "Upload and delete takes, or use a larger disk for the spool."),
    "calibration_missing": Rule(0.0, 0.0, "", "now", "matrices without which there is no episode",
        "Calibrate with `dextouch station calibrate` before recording."),
    "calibration_age": Rule(604_800.0, NEVER, "days", "now", "age of the oldest calibration",
        "Calibrate again with `dextouch station calibrate`."),
    "overload": Rule(0.02, 0.1, "ms", "10 s", "90th percentile of how late a thread wakes",
        "Close other programs, or set the cameras to smaller or fewer images."),
    "host_suspended": Rule(0.0, NEVER, "", "20 s", "times that this computer slept",
        "Turn off sleep and hibernation on this computer while the station runs."),
    "wall_clock_set": Rule(0.0, NEVER, "", "60 s", "times that the wall clock was set by 0.1 s",
        "Set up time synchronization (chrony); timestamps within takes are not affected."),
    "upload_refused": Rule(0.0, NEVER, "", "now", "takes refused by the store; they stay here",
        "Resolve the reason that the store gives, then send the take again."),
}
# fmt: on


@dataclass(frozen=True)
class CauseRule:
    """What a root cause is.

    Attributes:
        title: what it is called.
        meaning: when it is found.
        advice: what to do; empty where it is that of the leading finding.
    """

    title: str
    meaning: str
    advice: str


# From the widest to the narrowest; `services.acquisition.health.causes` finds them.
# fmt: off
CAUSES: Final[Mapping[CauseCode, CauseRule]] = {
    "host": CauseRule("This computer",
        "`overload`, `host_suspended`, or 3 and half of the devices have `latency` or `queue`, or "
        "are late in any way while all processors are busy",
        CODES["overload"].advice),
    "hub": CauseRule("USB hub", "all devices of a USB hub (2 or more) are gone, or lose data",
        "Check the plug and the power supply of this hub, and spread its devices over more ports."),
    "network": CauseRule("Network",
        "all devices of a remote host (2 or more) are gone, or lose data",
        "Check cable, switch and power on the way to this host, and use a direct link."),
    "bridge": CauseRule("Bridge",
        "all devices behind a local program (2 or more) are gone, or lose data",
        "Restart the program that brings these devices, and look into its log."),
    "gone": CauseRule("Device gone", "a device is `unplugged`, or `silent` for 2 s or more", ""),
    "clock": CauseRule("Clock", "`clock_step` of a device, with what follows from it", ""),
    "device": CauseRule("Device",
        "what else is raised of a device, led by its gravest finding", ""),
    "station": CauseRule("Station",
        "findings of the station: disk, wall clock, calibration, uploads", ""),
}
# fmt: on


def cause_table() -> str:
    """The causes as a table in Markdown."""
    rows = [
        f"| `{code}` | {rule.meaning} | {rule.advice or 'as the finding says'} |"
        for code, rule in CAUSES.items()
    ]
    return "\n".join(["| cause | found when | advice |\n|---|---|---|", *rows])


def table() -> str:
    """The codes as a table in Markdown."""
    rows = [
        f"| `{code}` | {rule.meaning} | {_shown(rule.warn if rule.error else NEVER, rule.unit)} "
        f"| {_shown(rule.error, rule.unit)} | {rule.window} | {rule.advice} |"
        for code, rule in CODES.items()
    ]
    head = "| code | value | WARN above | ERROR from | window | advice |\n|---|---|---|---|---|---|"
    return "\n".join([head, *rows])


def _shown(limit: float, unit: str) -> str:
    if limit in {0, NEVER}:
        return "any" if limit == 0 else "-"
    return f"{limit * _SHOWN_AS.get(unit, 1.0):g} {unit}".rstrip()
