"""What URDF and MJCF have in common: links (bodies) in a tree, joined by fixed steps and joints."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from dextouch.hands.finger_table import Vector3


class Joint(NamedTuple):
    """A joint in the frame of its link.

    Attributes:
        name: as the model has it.
        where: what messages about it begin with.
        anchor_m: a point of its axis in the link's frame.
        axis: unit vector in the link's frame.
        limits_rad: lowest and highest angle; none where it is no limited hinge.
        zero_rad: the angle at which the link stands as the file draws it.
        refusal: why a finger cannot have this joint; none if it can.
    """

    name: str
    where: str
    anchor_m: Vector3 = (0.0, 0.0, 0.0)
    axis: Vector3 = (0.0, 0.0, 1.0)
    limits_rad: tuple[float, float] | None = None
    zero_rad: float = 0.0
    refusal: str | None = None


class Link(NamedTuple):
    """A link: T_parent_link [4, 4] as drawn, and the joints that move it, in their order."""

    T_parent_link: np.ndarray
    joints: tuple[Joint, ...]


@runtime_checkable
class ModelFile(Protocol):
    """A model whose links are read when asked for: only what a finger stands on has to be sound."""

    @property
    def source(self) -> str:
        """File name, for messages."""
        ...

    @property
    def parents(self) -> Mapping[str, str | None]:
        """Every link's parent; none of a root."""
        ...

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of marked points (MJCF)."""
        ...

    def link(self, name: str) -> Link:
        """One of `parents`."""
        ...

    def site(self, name: str) -> tuple[str, np.ndarray]:
        """The link of one of `sites`, and T_link_site [4, 4]."""
        ...
