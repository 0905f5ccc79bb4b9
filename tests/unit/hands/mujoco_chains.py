"""MuJoCo's view of a model: hinges and tips in the wrist's frame, to compare a `HandModel` with."""

import mujoco
import numpy as np


class MujocoChains:
    """Kinematics of a compiled model, seen from one body.

    Args:
        model: `mujoco.MjModel`.
        wrist: name of the body.
        R_wrist_ours: our wrist axes in that body's frame.
    """

    def __init__(self, model, wrist, R_wrist_ours):
        self.model, self.data = model, mujoco.MjData(model)
        self._wrist, self._R = model.body(wrist).id, np.asarray(R_wrist_ours, dtype=float)

    def pose(self, joint_names, joints_rad):
        """Every named joint at its angle, all others where they are drawn."""
        self.data.qpos[:] = self.model.qpos0
        for name, angle in zip(joint_names, joints_rad, strict=True):
            self.data.qpos[self.model.joint(name).qposadr[0]] = angle
        mujoco.mj_kinematics(self.model, self.data)

    def _turned(self, vector):
        R_world_ours = self.data.xmat[self._wrist].reshape(3, 3) @ self._R
        return R_world_ours.T @ vector

    def _seen(self, point_world):
        return self._turned(point_world - self.data.xpos[self._wrist])

    def hinges(self, joint_names):
        """Anchor and axis [J, 3] of each joint."""
        ids = [self.model.joint(name).id for name in joint_names]
        anchors = np.array([self._seen(self.data.xanchor[index]) for index in ids])
        return anchors, np.array([self._turned(self.data.xaxis[index]) for index in ids])

    def body(self, name, offset_m=(0.0, 0.0, 0.0)):
        body = self.model.body(name).id
        offset = self.data.xmat[body].reshape(3, 3) @ np.asarray(offset_m)
        return self._seen(self.data.xpos[body] + offset)

    def site(self, name, offset_m=(0.0, 0.0, 0.0)):
        site = self.model.site(name).id
        offset = self.data.site_xmat[site].reshape(3, 3) @ np.asarray(offset_m)
        return self._seen(self.data.site_xpos[site] + offset)


def hand_hinges(hand, joints_rad):
    """Origins and axes [T, J, 3] of a `HandModel`'s hinges in wrist coordinates."""
    frames = hand.joint_frames(joints_rad)
    fingers = [
        (frames[:, index, place, :3, 3], frames[:, index, place, :3, :3] @ np.array(row.axis))
        for index, finger in enumerate(hand.fingers)
        for place, row in enumerate(finger.joints)
    ]
    return tuple(np.stack(parts, axis=1) for parts in zip(*fingers, strict=True))


def random_angles(hand, count, seed):
    """Joint angles [T, J] over the whole limits; the first two rows are the limits themselves."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(hand.lower_rad, hand.upper_rad, (count, len(hand.joint_names)))
    angles[0], angles[1] = hand.lower_rad, hand.upper_rad
    return angles
