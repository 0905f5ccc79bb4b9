"""MJCF of one random chain of hinges, written down in every way that the format has."""

import numpy as np

# What MuJoCo needs beside the kinematics to compile a chain without meshes.
INERTIAL = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/>'


def random_chain(seed, num_hinges):
    """Hinges j0, j1, … between body "w" and site "tip"; limits, turns and places at random.

    Numbers come in degrees or radians, from the element or one of two default classes; bodies hold
    no, one or two hinges; bodies, hinges and the site may stand in frames.
    """
    return _Writer(seed).text(num_hinges)


def _numbers(values):
    return " ".join(repr(float(value)) for value in values)


class _Writer:
    def __init__(self, seed):
        self._rng = np.random.default_rng(seed)
        self._degrees = bool(self._rng.integers(2))
        # Without autolimits every range has to say that it counts.
        self._limited = ' limited="true"' if seed % 3 == 0 else ""
        self._num_bodies = 0

    def text(self, num_hinges):
        angle = "" if self._degrees else ' angle="radian"'
        auto = ' autolimits="false"' if self._limited else ""
        axes = "".join(self._rng.choice(list("xyzXYZ"), 3))
        names = [f"j{index}" for index in range(num_hinges)]
        return (
            f'<mujoco model="chain"><compiler{angle} eulerseq="{axes}"{auto}/>{self._defaults()}'
            f'<worldbody><body name="arm" pos="1 2 3" {self._orientation()}>{INERTIAL}'
            f'<joint name="arm" type="slide" axis="1 0 0" {self._limits()}/>'
            f'<body name="w" {self._place()}>{INERTIAL}{self._body(names)}</body>'
            "</body></worldbody></mujoco>"
        )

    def _defaults(self):
        return (
            f'<default><joint axis="{self._vector(1.0)}"/><default class="a">'
            f'<joint {self._limits()} ref="{self._angle(0.3)}"/>'
            f'<default class="b"><joint pos="{self._vector(0.01)}"/>'
            f"<site {self._orientation()}/></default></default></default>"
        )

    def _maybe(self, text):
        return text if self._rng.integers(2) else ""

    def _vector(self, size):
        return _numbers(self._rng.normal(0, size, 3))

    def _angle(self, size):
        angle = self._rng.uniform(-size, size)
        return repr(float(np.rad2deg(angle) if self._degrees else angle))

    def _limits(self):
        lower = self._rng.uniform(-1.2, -0.2)
        both = np.array([lower, lower + self._rng.uniform(0.5, 2.0)])
        return f'range="{_numbers(np.rad2deg(both) if self._degrees else both)}"{self._limited}'

    def _orientation(self):
        kind = self._rng.choice(["quat", "axisangle", "euler", "xyaxes", "zaxis"])
        if kind == "euler":
            return f'euler="{self._angle(3.0)} {self._angle(3.0)} {self._angle(3.0)}"'
        if kind == "axisangle":
            return f'axisangle="{self._vector(1.0)} {self._angle(3.0)}"'
        size = {"quat": 4, "xyaxes": 6, "zaxis": 3}[kind]
        return f'{kind}="{_numbers(self._rng.normal(size=size))}"'

    def _place(self):
        return f'pos="{self._vector(0.02)}" {self._orientation()}'

    def _joint(self, name):
        if self._rng.integers(3) == 0:
            return f'<joint name="{name}" class="{self._rng.choice(["a", "b"])}"/>'
        axis = self._maybe(f'axis="{self._vector(1.0)}"')
        anchor = f'pos="{self._vector(0.01)}" ref="{self._angle(0.5)}"'
        return f'<joint name="{name}" {self._limits()} {anchor} {axis}/>'

    def _body(self, names):
        if not names:
            site = '<site name="tip" class="b" pos="0 0 0.02"/>'
            return f"<body {self._place()}>{INERTIAL}<frame {self._place()}>{site}</frame></body>"
        count = min(len(names), self._rng.integers(3))
        joints = [self._joint(name) for name in names[:count]]
        if joints and self._rng.integers(2):
            joints[0] = f"<frame {self._place()}>{joints[0]}</frame>"
        self._num_bodies += 1
        name = self._maybe(f'name="b{self._num_bodies}"')
        child_class = self._maybe('childclass="a"')
        inner = f"{INERTIAL}{''.join(joints)}{self._body(names[count:])}"
        body = f"<body {name} {self._place()} {child_class}>{inner}</body>"
        if self._rng.integers(2):
            return f'<frame {self._place()} childclass="a">{body}</frame>'
        return body
