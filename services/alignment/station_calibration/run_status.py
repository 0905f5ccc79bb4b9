"""Bodies of the routes of guided calibration runs: their requests, answers and state."""

from typing import Literal

from pydantic import AwareDatetime, Field

from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel, example
from services.alignment.calibration.hand_eye import GaugeView

Order = Literal["take", "drop"]
RunState = Literal["running", "asking", "done", "failed", "cancelled"]
ENDED: frozenset[RunState] = frozenset({"done", "failed", "cancelled"})
Outline = tuple[tuple[float, float], ...]


class RunRequest(FrozenModel):
    """A guided run.

    `camera` measures the lens of a camera with a board, `mount` where it sits on its tracker with a
    fixed board, `glove` tare and gain of a glove, and `time` the path delays of `all` trackers and
    cameras. `is_resumed` goes on with the places of a mount's run that was ended.
    """

    model_config = example(kind="glove", subject="left")

    kind: Literal["camera", "mount", "glove", "time"]
    subject: Literal["head", "wrist_left", "wrist_right", "left", "right", "all"]
    board: FreeText = Field(default="", max_length=64)
    is_resumed: bool = False


class Answer(FrozenModel):
    """What the operator answers to the question of a run."""

    model_config = example(text="yes")

    text: FreeText = Field(max_length=200)


class ImageView(FrozenModel):
    """The newest image of a camera and the board's corners in it, in its pixels.

    `todo` is advice, most important first; `hint` says why the image was not kept.
    """

    image_index: int
    width_px: int
    height_px: int
    corners_px: Outline = ()
    todo: tuple[str, ...] = ()
    hint: str = ""


class CameraRunView(ImageView):
    """Live view of a camera run.

    `outlines_px` are those of the boards that were kept. `focal_sigma` is the standard deviation of
    the focal length that the views give, as a share of it, None where they give none; the run goes
    on until it is `focal_sigma_wanted`.
    """

    outlines_px: tuple[Outline, ...] = ()
    views_by_region: tuple[tuple[int, ...], ...] = ()
    num_views: int = 0
    num_wanted: int
    focal_sigma: float | None = None
    focal_sigma_wanted: float


class MountRunView(ImageView):
    """Live view of a mount's run.

    `places` are the kept ones in their order, True where they count: the solver leaves out those
    that are far from the others. The run ends by itself when all `gauges` are full. `problem` is
    why the solver refuses the places, `can_finish` says whether they determine the mount.
    """

    is_board_seen: bool
    is_tracked: bool
    is_still: bool
    places: tuple[bool, ...]
    gauges: tuple[GaugeView, ...]
    problem: str = ""
    can_finish: bool = False


class Choice(FrozenModel):
    """An answer to a question other than its action, and what it does."""

    label: str
    answer: str


class Countdown(FrozenModel):
    """What lasts for a known time, and how much of it is over."""

    label: str
    duration_s: float
    elapsed_s: float = 0.0


class RunStatus(FrozenModel):
    """State of a guided run; `lines` is what it said, `question` what it waits for.

    `action` is what an answer starts, such as "Record 10 s"; it is a text if `takes_text`, else
    empty. `choices` are other answers. `facts` are the results as in `calibration_details.json`.
    """

    run_id: str
    request: RunRequest
    state: RunState
    started_at: AwareDatetime
    question: str = ""
    action: str = ""
    takes_text: bool = False
    choices: tuple[Choice, ...] = ()
    lines: tuple[str, ...] = ()
    countdown: Countdown | None = None
    camera: CameraRunView | None = None
    mount: MountRunView | None = None
    facts: dict[str, object] = Field(default_factory=dict)
    problem: str = ""
