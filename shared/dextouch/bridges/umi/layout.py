"""Array names of a UMI-style replay buffer and the data that each holds."""

from typing import Final

MODEL_CAMERAS: Final = ("camera_wrist_left", "camera_wrist_right", "camera_head")
# robot0 is the left hand, robot1 the right one.
ROBOTS: Final = {"robot0": "left", "robot1": "right"}
ENDS: Final = "meta/episode_ends"
ATTRIBUTES_KEY: Final = "dextouch"
LAYOUT_VERSION: Final = 1
CHUNK_ROWS: Final = 256


def camera_array(index: int) -> str:
    """Name of the image array of a camera."""
    return f"data/camera{index}_rgb"


def camera_dt_array(index: int) -> str:
    """Name of the array of image time minus step time, for a camera."""
    return f"data/camera{index}_dt_ns"


# Arrays of numbers: type and shape of a row.
NUMBERS: Final[dict[str, tuple[str, tuple[int, ...]]]] = {
    **{
        f"data/{robot}_{name}": kind
        for robot in ROBOTS
        for name, kind in {
            "eef_pos": ("<f4", (3,)),
            "eef_rot_axis_angle": ("<f4", (3,)),
            "joint_pos": ("<f4", (20,)),
            "demo_start_pose": ("<f8", (6,)),
            "demo_end_pose": ("<f8", (6,)),
        }.items()
    },
    "data/head_pos": ("<f4", (3,)),
    "data/head_rot_axis_angle": ("<f4", (3,)),
    "data/tactile": ("<f4", (2, 320)),
    "data/tactile_valid": ("|b1", (2,)),
    "data/action": ("<f8", (67,)),
    "data/t_ref_ns": ("<i8", ()),
}
COMMANDED: Final = "data/action_commanded"
