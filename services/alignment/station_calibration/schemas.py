"""Bodies of the routes of a station's calibration: overview, guided runs and answers."""

from typing import Literal

from pydantic import AwareDatetime, Field

from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel

ItemState = Literal["good", "due", "missing", "optional"]
RunState = Literal["running", "asking", "done", "failed", "cancelled"]
ENDED: frozenset[RunState] = frozenset({"done", "failed", "cancelled"})


class RunRequest(FrozenModel):
    """A guided run: intrinsics of a camera with a board, or tare and gain of a glove."""

    kind: Literal["camera", "glove"]
    subject: Literal["head", "wrist_left", "wrist_right", "left", "right"]
    board: FreeText = Field(default="", max_length=64)


class Answer(FrozenModel):
    """What the operator answers to the question of a run."""

    text: FreeText = Field(max_length=200)


class CalibrationItem(FrozenModel):
    """One calibration: how old and how accurate it is, and the next step.

    `sigma` and `residual` are in words, empty where unknown; `meaning` says what a residual tells.
    `views_by_region` counts views of the board in each ninth of the image. `run` starts the guided
    run, where there is one; `step` says what to do otherwise.
    """

    name: str
    title: str
    state: ItemState
    age_days: float | None = None
    sigma: str = ""
    residual: str = ""
    meaning: str = ""
    reasons: tuple[str, ...] = ()
    step: str
    run: RunRequest | None = None
    views_by_region: tuple[tuple[int, ...], ...] = ()


class CalibrationOverview(FrozenModel):
    """Everything that is or should be calibrated at a station; `note` says what is unknown."""

    folder: str
    items: tuple[CalibrationItem, ...]
    note: str = ""


Outline = tuple[tuple[float, float], ...]


class CameraRunView(FrozenModel):
    """Live view of a camera run: the newest image and what was seen in it, in its pixels.

    `corners_px` are those of the newest image, `outlines_px` those of the boards that were kept.
    `focal_sigma` is the standard deviation of the focal length that the views give, as a share of
    it, None where they give none; the run goes on until it is `focal_sigma_wanted`.
    """

    image_index: int
    width_px: int
    height_px: int
    corners_px: Outline = ()
    outlines_px: tuple[Outline, ...] = ()
    views_by_region: tuple[tuple[int, ...], ...] = ()
    num_views: int = 0
    num_wanted: int
    focal_sigma: float | None = None
    focal_sigma_wanted: float
    todo: tuple[str, ...] = ()
    hint: str = ""


class RunStatus(FrozenModel):
    """State of a guided run; `lines` is what it said, `question` what it waits for.

    `facts` are the results as in `calibration_details.json`.
    """

    run_id: str
    request: RunRequest
    state: RunState
    started_at: AwareDatetime
    question: str = ""
    lines: tuple[str, ...] = ()
    busy_s: float = 0.0
    camera: CameraRunView | None = None
    facts: dict[str, object] = Field(default_factory=dict)
    problem: str = ""
