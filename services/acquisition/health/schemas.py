"""The bodies of a station's health routes: its streams, its devices, and what was raised when."""

from typing import Literal

from pydantic import Field, FiniteFloat

from dextouch.frozen_model import FrozenModel
from services.acquisition.health.codes import CODES, Code, Level, StaleCode


class RaisedFinding(FrozenModel):
    """Something that is wrong now, since when, and what to do about it.

    `lasted_s` is None where nothing was ever heard of a stream.
    """

    code: Code
    level: Literal["WARN", "ERROR", "STALE"]
    message: str
    advice: str
    lasted_s: float | None

    @classmethod
    def since(
        cls, code: Code, level: Level, message: str, *, lasted_ns: int | None
    ) -> "RaisedFinding":
        """The finding with the advice of its code."""
        return cls.model_validate(
            {
                "code": code,
                "level": level,
                "message": message,
                "advice": CODES[code].advice,
                "lasted_s": None if lasted_ns is None else max(0, lasted_ns) / 1e9,
            }
        )


class StreamHealth(FrozenModel):
    """One stream at this moment; `lost` and `received` count its device's packets since start.

    `stale` says why nothing is known; it is the first of the findings then. `reasons` are their
    messages. `figures` are the numbers behind them by their Prometheus names, none while the
    stream is stale.
    """

    stream: str
    device: str
    hand: Literal["left", "right"] | None = None
    level: Level
    stale: StaleCode | None = None
    reasons: tuple[str, ...]
    findings: tuple[RaisedFinding, ...] = ()
    figures: dict[str, FiniteFloat] = Field(default_factory=dict)
    rate_hz: float | None
    nominal_rate_hz: float
    age_s: float | None
    num_samples: int = 0
    received: int
    lost: int
    skew_ppm: float | None = None
    clock_residual_ms: float | None = None


class DeviceHealth(FrozenModel):
    """One device and its counters since the station's start."""

    device: str
    hand: Literal["left", "right"] | None = None
    connected: bool
    address: str
    packets: int
    lost: int
    crc_errors: int
    length_errors: int
    resync_bytes: int
    refused: int
    suspects: int = 0
    repeated: int = 0
    restarts: int = 0
    queue_dropped: int = 0
    reconnects: int
    failures: int = 0
    last_error: str | None


class StationHealth(FrozenModel):
    """All streams and devices; `level` is the worst of the streams and of `findings`.

    `findings` and `figures` are those of the station itself: disk, calibration and uploads.
    """

    station: str
    level: Level
    findings: tuple[RaisedFinding, ...] = ()
    figures: dict[str, FiniteFloat] = Field(default_factory=dict)
    streams: tuple[StreamHealth, ...]
    devices: tuple[DeviceHealth, ...]


class HealthEvent(FrozenModel):
    """A code of a stream (or of the `station`) reached a level; OK is its end."""

    t_host_ns: int
    stream: str
    code: Code
    level: Level


class HealthEvents(FrozenModel):
    """Changes of levels, oldest first, and the station's clock now."""

    now_ns: int
    events: tuple[HealthEvent, ...]
