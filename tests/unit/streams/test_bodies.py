"""Poses of a person who reaches forward, read, scaled and exchanged in every wrong way."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dextouch.streams import implausible_bodies

NAMES = ("head", "wrist_left", "wrist_right")


def person(seed=0, count=600):
    """Head and wrists [n, 7]; x to the right, y forward and z up, all in metres."""
    rng = np.random.default_rng(seed)
    starts_m = dict(zip(NAMES, ([0, 0, 1.5], [-0.2, 0.4, 1.1], [0.2, 0.4, 1.1]), strict=True))
    poses = {}
    for name, start_m in starts_m.items():
        waves = gaussian_filter1d(rng.standard_normal((count, 6)), 30, axis=0)
        waves /= waves.std()
        # The view, along z, is forward and down; fingers, along -z of the wrist, point forward.
        turn = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
        if name == "head":
            turn = Rotation.from_euler("x", -120, degrees=True)
        turn = Rotation.from_rotvec(0.1 * waves[:, 3:]) * turn
        poses[name] = np.hstack([start_m + 0.05 * waves[:, :3], turn.as_quat()[:, [3, 0, 1, 2]]])
    return poses


def found(poses, *, of_robot=False, to_body=None):
    one = implausible_bodies(poses, to_body or {}, of_robot=of_robot)
    return None if one is None else (one.stream, one.cause, one.message)


def all_of(poses, change):
    return {name: change(of) for name, of in poses.items()}


def turned(pose, R):
    """Another choice of the world's axes, right-handed or not (scipy does the algebra)."""
    matrices = Rotation.from_quat(pose[:, [4, 5, 6, 3]]).as_matrix()
    matrices = R @ matrices @ (R.T if np.linalg.det(R) < 0 else np.eye(3))
    quaternions = Rotation.from_matrix(matrices).as_quat()[:, [3, 0, 1, 2]]
    return np.hstack([pose[:, :3] @ R.T, quaternions])


@pytest.mark.parametrize("seed", range(5))
def test_a_person_is_plausible_at_any_place_and_heading(seed):
    poses = person(seed)
    assert found(poses) is None
    R = Rotation.from_euler("z", 1.3 * seed).as_matrix()
    elsewhere = all_of(poses, lambda of: np.add(turned(of, R), [3.0, -2.0, 0, 0, 0, 0, 0]))
    assert found(elsewhere) is None
    assert found({name: of[:50] for name, of in poses.items()}) is None
    assert found({name: poses[name] for name in NAMES[:2]}) is None


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("millimetres", 1e3), ("centimetres", 1e2), ("inches", 1 / 0.0254), ("feet", 1 / 0.3048),
        ("decimetres", 10), ("kilometres", 1e-3),
    ],
)  # fmt: skip
@pytest.mark.parametrize("scope", [("wrist_right",), NAMES], ids=["one", "all"])
def test_units_are_named_by_what_a_person_reaches(unit, factor, scope):
    scale = [factor] * 3 + [1] * 4
    poses = {name: of * (scale if name in scope else 1) for name, of in person().items()}
    stream, cause, message = found(poses)
    assert (stream in scope, cause) == (True, "unit")
    assert f"these look like {unit}" in message


@pytest.mark.parametrize(
    ("columns", "signs", "said"),
    [
        ([4, 5, 6, 3], [1, 1, 1, 1], "are x, y, z, w;"),
        ([3, 4, 5, 6], [1, -1, -1, -1], "are conjugates;"),
        ([4, 5, 6, 3], [-1, -1, -1, 1], "are conjugates x, y, z, w;"),
    ],
)
def test_other_quaternions_of_the_head_are_named(columns, signs, said):
    for seed in range(3):
        poses = person(seed)
        poses["head"][:, 3:] = poses["head"][:, columns] * signs
        stream, cause, message = found(poses)
        assert (stream, cause) == ("head", "quaternion_order")
        assert said in message


@pytest.mark.parametrize(
    ("R", "stream", "cause", "said"),
    [
        (np.diag([-1, 1, 1]), "wrist_left", "swapped", "right-handed axes"),
        (np.diag([1, 1, -1]), "head", "axes", "mirrored z"),
        (np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), "head", "axes", "whose y points up"),
    ],
    ids=["x", "z", "y up"],
)
def test_other_axes_of_all_trackers_are_named(R, stream, cause, said):
    for seed in range(3):
        name, why, message = found(all_of(person(seed), lambda of: turned(of, R)))
        assert (name, why, said in message) == (stream, cause, True)


def test_exchanged_trackers_and_one_tracker_for_two():
    poses = person()
    left, right, head = (poses[name] for name in ("wrist_left", "wrist_right", "head"))
    exchanged = found({**poses, "wrist_left": right, "wrist_right": left})
    assert exchanged[:2] == ("wrist_left", "swapped")
    assert "exchange the trackers" in exchanged[2]
    # What the head does as a hand may look like other quaternions: it is refused in any case.
    assert found({**poses, "head": left, "wrist_left": head})[0] == "head"
    both = found({**poses, "wrist_right": left})
    assert both[1] == "swapped"
    assert "of the same tracker" in both[2]


def test_a_robot_is_where_it_is_commanded_and_its_camera_anywhere():
    poses = person()
    commands = {f"{name}_commanded": poses[name] for name in NAMES[1:]}
    opposite = all_of(poses, lambda of: of * [-1, -1, 1, 1, 1, 1, 1])
    assert found({**poses, **commands}, of_robot=True) is None
    assert found({**opposite, "head": poses["head"] + [0, 5, 0, 0, 0, 0, 0]}, of_robot=True) is None
    left, right = poses["wrist_left"], poses["wrist_right"]
    exchanged = {**poses, **commands, "wrist_left": right, "wrist_right": left}
    assert found(exchanged, of_robot=True)[:2] == ("wrist_left", "swapped")


def test_mounts_come_before_the_judgement():
    poses = person()
    mount = Rotation.from_euler("y", 180, degrees=True)

    def to_body(of):
        q = (Rotation.from_quat(of[:, [4, 5, 6, 3]]) * mount).as_quat()[:, [3, 0, 1, 2]]
        return np.hstack([of[:, :3], q])

    tracked = {name: to_body(of) if name == "head" else of for name, of in poses.items()}
    assert found(tracked, to_body={"head": to_body}) is None


@pytest.mark.parametrize("lag_rad", [0.02, 0.1, 0.3])
def test_conjugates_of_a_robot_s_wrist_are_known_by_its_command(lag_rad):
    for seed in range(20):
        poses = person(seed)
        for name in NAMES[1:]:
            behind = Rotation.from_rotvec([0, lag_rad, 0]) * Rotation.from_quat(
                poses[name][:, [4, 5, 6, 3]]
            )
            quaternions = behind.as_quat()[:, [3, 0, 1, 2]]
            poses[f"{name}_commanded"] = np.hstack([poses[name][:, :3], quaternions])
        assert found(poses, of_robot=True) is None
        poses["wrist_left"] = poses["wrist_left"] * [1, 1, 1, 1, -1, -1, -1]
        stream, cause, message = found(poses, of_robot=True)
        assert (stream, cause) == ("wrist_left", "quaternion_order")
        assert "conjugates" in message


def test_a_robot_s_wrist_that_never_moves_though_it_is_commanded():
    for seed in range(20):
        poses = person(seed)
        poses |= {f"{name}_commanded": poses[name] for name in NAMES[1:]}
        noise = 1e-3 * np.random.default_rng(seed).standard_normal((600, 7))
        still = poses["wrist_right"][:1] + noise * ([1] * 3 + [0] * 4)
        assert found(poses | {"wrist_right": still}, of_robot=True)[:2] == ("wrist_right", "frozen")
