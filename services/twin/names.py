"""What command lines and settings choose from, by name; imports no simulation."""

from typing import Final, Literal, get_args

Domain = Literal["robot", "human"]
DOMAINS: Final[tuple[Domain, Domain]] = ("robot", "human")
CAMERAS: Final = ("camera_head", "camera_wrist_left", "camera_wrist_right")
StreamChoice = Literal["all", "training"]
STREAM_CHOICES: Final[tuple[StreamChoice, ...]] = get_args(StreamChoice)
MotionKind = Literal["retreat", "push", "slip", "wander"]
MOTION_KINDS: Final[tuple[MotionKind, ...]] = get_args(MotionKind)
# How takes become episodes: as they are, by devices and alignment, or as a station records them.
TakePath = Literal["direct", "devices", "station"]
TAKE_PATHS: Final[tuple[TakePath, ...]] = get_args(TakePath)
# Of `mistakes.KINDS` and `take_options.MIXES`.
MISTAKE_KINDS: Final = (
    *("height", "offset", "yaw", "tilt", "wrist_turn", "tempo", "pause", "finger_time", "grip"),
    *("opening", "finger", "release", "bumps", "sweep", "wrong_object", "jitter", "drift"),
    *("second_half", "one_hand_late", "side_approach", "low_rate", "overshoot", "frame_yaw"),
    *("smooth", "gain", "shake", "regrasp", "short", "roll", "rush", "quantized"),
)
MIX_NAMES: Final = ("evaluator", "demonstrations", "ladder", "development", "exact")
DEFAULT_MIX: Final = "evaluator"
# The paper's four tasks on which policies are trained and evaluated.
DOWNSTREAM: Final = ("place_shoes", "place_phone", "stack_bowls", "stand_bottle")
# Tasks of robot and of human episodes for pretraining: no task is in two of these three sets.
ROBOT_PRETRAINING: Final = ("insert_peg", "open_drawer", "turn_lever", "strike_bell")
HUMAN_PRETRAINING: Final = (
    *("lift_full_can", "lift_empty_can", "move_can_left", "move_can_right"),
    *("regrasp_can", "lift_box", "squeeze_ball"),
)
# Tasks of the package's checkpoints; commands record and evaluate these by default.
EVALUATED: Final = (
    *("stand_bottle", "stack_bowls", "insert_peg"),
    *("place_shoes", "place_phone", "open_drawer"),
)
TASK_SETS: Final[dict[str, tuple[str, ...]]] = {
    "downstream": DOWNSTREAM,
    "robot-pretraining": ROBOT_PRETRAINING,
    "human-pretraining": HUMAN_PRETRAINING,
    "evaluated": EVALUATED,
}
TASK_NAMES: Final = (
    *EVALUATED,
    *HUMAN_PRETRAINING[:-1],
    *("turn_lever", "strike_bell"),
    HUMAN_PRETRAINING[-1],
)
