"""Other retargeting libraries with their objectives, configured for our hand.

dex-retargeting and its port dexi-rs have three objectives, used here in the form that is best for a
hand with five full fingers: vectors from the wrist to PIP, DIP and tip of every finger, the same
points as positions, and DexPilot's ten vectors between the tips with the five from the wrist. They
run without their low-pass filter, which costs more accuracy than their solvers, and read the URDF
that is generated from our kinematic tables.
"""

import importlib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from dextouch.errors import UnavailableError
from dextouch.hands import CHAINS, solver_indices
from dextouch.hands.robot_hand import RobotHand

WRIST_LINK: Final = "wrist"
# URDF requires effort and velocity limits; neither is used here.
_EFFORT, _VELOCITY = "2", "10"


def hand_urdf(hand: RobotHand) -> str:
    """URDF of one hand: joints by their firmware names, links by `link_name`, no shapes.

    The root link is the wrist frame. Quaternions of the tables are converted to roll, pitch and
    yaw, exact to rounding.
    """
    robot = ET.Element("robot", name=f"{hand.side}_hand")
    ET.SubElement(robot, "link", name=WRIST_LINK)
    for index, finger in enumerate(hand.fingers):
        parent = WRIST_LINK
        for joint, row in enumerate(finger.joints):
            child = link_name(CHAINS[index], joint)
            element = _joint(robot, row.name, "revolute", (parent, child))
            # Angles about fixed x, then y, then z, as URDF wants them.
            R = Rotation.from_quat(row.q_wxyz, scalar_first=True)
            _origin(element, row.position_m, R.as_euler("xyz", suppress_warnings=True))
            ET.SubElement(element, "axis", xyz=_text(row.axis))
            low, high = row.limits_rad
            limit = ET.SubElement(element, "limit", effort=_EFFORT, velocity=_VELOCITY)
            limit.set("lower", repr(float(low)))
            limit.set("upper", repr(float(high)))
            parent = child
        tip = tip_name(CHAINS[index])
        _origin(_joint(robot, f"{tip}_mount", "fixed", (parent, tip)), finger.tip_m, (0.0,) * 3)
    return ET.tostring(robot, encoding="unicode")


def link_name(chain: str, joint: int) -> str:
    """The link that a joint of a chain moves; its origin is the joint's."""
    return f"{chain}_{joint}"


def tip_name(chain: str) -> str:
    """The link at a fingertip."""
    return f"{chain}_tip"


def _joint(robot: ET.Element, name: str, kind: str, links: tuple[str, str]) -> ET.Element:
    parent, child = links
    ET.SubElement(robot, "link", name=child)
    element = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    return element


def _origin(element: ET.Element, xyz: Iterable[float], rpy: Iterable[float]) -> None:
    ET.SubElement(element, "origin", xyz=_text(xyz), rpy=_text(rpy))


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


INSTALL: Final = "pip install -c constraints.txt '.[bench]'"
DEX, DEXI = "dex", "dexi"
VECTOR, POSITION, DEXPILOT = "vector15", "position15", "dexpilot"
_WRIST_NODE: Final = 0
_NODES: Final = [node for chain in CHAINS for node in solver_indices(chain)[1:]]
_LINKS: Final = [
    name for chain in CHAINS for name in (link_name(chain, 2), link_name(chain, 3), tip_name(chain))
]
_TIP_NODES: Final = [solver_indices(chain)[-1] for chain in CHAINS]
# DexPilot's pairs (from, to) of the wrist, 0, and the tips, 1 … 5, in the order of both libraries.
_PAIRS: Final = np.array(
    [(b, a) for a in range(1, 5) for b in range(a + 1, 6)] + [(0, tip) for tip in range(1, 6)]
)


class Rival(NamedTuple):
    """One library with one objective."""

    library: str
    objective: str

    @property
    def name(self) -> str:
        """Name in tables."""
        return f"{self.library} {self.objective}"


RIVALS: Final[Mapping[str, Rival]] = {
    rival.name: rival
    for rival in (
        Rival(library, objective)
        for library in (DEX, DEXI)
        for objective in (VECTOR, POSITION, DEXPILOT)
    )
}
_MODULES: Final = {DEX: ("dex_retargeting", "nlopt", "pinocchio", "torch"), DEXI: ("dexi_rs",)}
# Joint angles of one reference, the library's own order.
Solve = Callable[[Any], Any]


class Setup(NamedTuple):
    """A configured library: its references, its solve function and its joint order."""

    references: list[Any]
    solve: Solve
    joint_names: list[str]


class Timed(NamedTuple):
    """Joint angles [T, 20], processor time of all samples, wall time of each sample's own call."""

    joints_rad: Float64[np.ndarray, "time 20"]
    cpu_s: float
    call_s: Float64[np.ndarray, " calls"]


def missing_modules(rival: Rival) -> list[str]:
    """Modules of a rival that are not installed, checked without importing."""
    return [module for module in _MODULES[rival.library] if find_spec(module) is None]


def references(
    rival: Rival, keypoints_m: np.ndarray, scale: float
) -> Float64[np.ndarray, "time 15 3"]:
    """Reference vectors or positions for a rival from samples [T, 25, 3], metres.

    Positions are scaled here; vectors by the libraries, as DexPilot's thresholds require.
    """
    keypoints = np.asarray(keypoints_m, dtype=np.float64)
    wrist = keypoints[:, _WRIST_NODE, None]
    if rival.objective == VECTOR:
        return np.asarray(keypoints[:, _NODES] - wrist)
    if rival.objective == POSITION:
        return np.asarray(keypoints[:, _NODES] - wrist) * scale
    points = np.concatenate([wrist, keypoints[:, _TIP_NODES]], axis=1)
    return np.asarray(points[:, _PAIRS[:, 1]] - points[:, _PAIRS[:, 0]])


def set_up(
    rival: Rival, keypoints_m: np.ndarray, side: str, *, scale: float, folder: Path
) -> Setup:
    """Create a retargeter for the robot hand of one side, with its references.

    Keypoints are [T, 25, 3] in wrist coordinates, `scale` is the size of the robot's hand relative
    to the tracked one, the folder is for the URDF. Raises UnavailableError if its library is not
    installed.
    """
    missing = missing_modules(rival)
    if missing:
        raise UnavailableError(f"{rival.name}: {', '.join(missing)} not installed; {INSTALL}")
    hand = RobotHand(side)
    path = folder / f"{side}_hand.urdf"
    path.write_text(hand_urdf(hand), encoding="utf-8")
    config = {"urdf_path": str(path), **_config(rival.objective), "low_pass_alpha": -1.0}
    config["target_joint_names"] = list(hand.joint_names)
    config["scaling_factor"] = scale
    targets = references(rival, keypoints_m, scale)
    if rival.library == DEX:
        importlib.import_module("torch").set_num_threads(1)
        module = importlib.import_module("dex_retargeting.retargeting_config")
        built = module.RetargetingConfig.from_dict(config).build()
        return Setup(list(targets), built.retarget, list(built.joint_names))
    built = importlib.import_module("dexi_rs").load_config(config).build()
    flat = targets.reshape(len(targets), -1).tolist()
    return Setup(flat, built.retarget, list(built.joint_names))


def _config(objective: str) -> dict[str, Any]:
    if objective == VECTOR:
        return {
            "type": "vector",
            "target_origin_link_names": [WRIST_LINK] * len(_LINKS),
            "target_task_link_names": _LINKS,
            "target_link_human_indices": [[_WRIST_NODE] * len(_NODES), _NODES],
        }
    if objective == POSITION:
        return {
            "type": "position",
            "target_link_names": _LINKS,
            "target_link_human_indices": _NODES,
        }
    tips = [tip_name(chain) for chain in CHAINS]
    return {"type": "dexpilot", "wrist_link_name": WRIST_LINK, "finger_tip_link_names": tips}
