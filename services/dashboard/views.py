"""View models of the page, validated and in its display units."""

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from dextouch.frozen_model import FrozenModel
from dextouch.tactile import CONTACT_THRESHOLD_KPA, colour, hand_canvas
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side

Level = Literal["OK", "WARN", "ERROR", "STALE"]
LEVELS: tuple[Level, ...] = ("OK", "WARN", "STALE", "ERROR")
FULL_SCALE_KPA = 40.0
RAMP_STEPS = 128
TAXEL_MESSAGE = 1


class StreamView(BaseModel):
    """One row of the device table; None where not measured.

    `advice` refers to the most severe problem in `message`, which has lasted for `lasted_s`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    device: str
    level: Level
    message: str = ""
    advice: str = ""
    lasted_s: float | None = None
    rate_hz: float | None = None
    nominal_rate_hz: float | None = None
    dropped: int | None = None
    drop_percent: float | None = None
    age_s: float | None = None
    skew_ppm: float | None = None
    clock_error_ms: float | None = None


class PromptView(BaseModel):
    """The armed prompt, with the page's fields."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    task: str
    instruction: str
    domain: str = "human"
    operator: str | None = None
    consent: bool = False


class RecorderView(BaseModel):
    """State of the recorder and its available actions.

    `note` summarizes the check of the take, `problems` lists its findings, worst first.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    state: str
    actions: tuple[str, ...] = ()
    recording_id: str | None = None
    prompt: PromptView | None = None
    elapsed_s: float | None = None
    level: Level = "OK"
    complete: bool = True
    note: str = ""
    problems: tuple[str, ...] = ()


class StationView(FrozenModel):
    """Overview of the station."""

    reachable: bool
    level: Level
    summary: str
    note: str
    note_level: Level
    streams: tuple[StreamView, ...]
    recorder: RecorderView


class ServiceView(FrozenModel):
    """Readiness of a service."""

    name: str
    level: Level
    message: str


class TakeView(FrozenModel):
    """A stored recording or episode; `consent` is None where unknown."""

    kind: Literal["recording", "episode"]
    name: str
    task: str
    domain: str
    operator: str | None
    consent: bool | None
    outcome: str
    size: str
    clocks: str = ""


class RefusedView(BaseModel):
    """A take that the store refused, and the reason."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    recording_id: str
    error: str


class TakesView(FrozenModel):
    """The newest takes; `note` explains an empty list. `refused` ones are still at the station."""

    refused: tuple[RefusedView, ...] = ()
    takes: tuple[TakeView, ...] = ()
    note: str = ""


class CameraView(BaseModel):
    """A camera with an image to show."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    name: str
    image_index: int
    age_s: float | None


def worst(levels: list[Level]) -> Level:
    """The most severe level; STALE if there is none."""
    return max(levels, key=LEVELS.index) if levels else "STALE"


def unreachable_station(reason: str) -> StationView:
    """The station view while the acquisition service is unreachable, without stale values."""
    return StationView(
        reachable=False,
        level="ERROR",
        summary="acquisition does not respond",
        note=reason,
        note_level="ERROR",
        streams=(),
        recorder=RecorderView(state="unknown", level="ERROR"),
    )


def heatmap_layout() -> dict[str, object]:
    """Positions of the 320 taxels and the colour map, from `dextouch.tactile`."""
    cells = {side: _cells(side) for side in SIDES}
    rows, columns = hand_canvas(np.zeros(NUM_TAXELS, dtype=np.float32), side="right").shape
    pressures_kpa = np.linspace(0.0, FULL_SCALE_KPA, RAMP_STEPS)
    return {
        "rows": rows,
        "columns": columns,
        "cells": cells,
        "ramp": colour(pressures_kpa, full_scale_kpa=FULL_SCALE_KPA).tolist(),
        "full_scale_kpa": FULL_SCALE_KPA,
        "contact_kpa": CONTACT_THRESHOLD_KPA,
    }


def taxel_message(side: Side, pressures_kpa: np.ndarray) -> bytes:
    """Encode pressures: uint8 kind, uint8 side, uint16 count, then float32 kPa, little endian."""
    header = bytes([TAXEL_MESSAGE, SIDES.index(side)]) + len(pressures_kpa).to_bytes(2, "little")
    return header + np.ascontiguousarray(pressures_kpa, dtype="<f4").tobytes()


def _cells(side: Side) -> list[int]:
    canvas = hand_canvas(np.arange(NUM_TAXELS, dtype=np.float32), side=side)
    used = np.flatnonzero(~np.isnan(canvas))
    order = np.argsort(canvas.ravel()[used])
    return [int(cell) for cell in used[order]]
