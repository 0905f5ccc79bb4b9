"""Schemas of the files that describe the objects of tasks, and say where they were clicked."""

import math
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, FiniteFloat, ValidationError, field_validator, model_validator

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.frozen_model import FrozenModel, example, is_none
from dextouch.schemas.common import Box, StoreId, first_problems

# Position x y z (m), then the quaternion w x y z.
Pose = tuple[
    FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat
]
MarkerDictionary = Literal[
    "DICT_4X4_50", "DICT_5X5_250", "DICT_6X6_250", "DICT_APRILTAG_16h5", "DICT_APRILTAG_36h11"
]
# An axis of an object's frame, or the direction against it.
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
ObjectName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,47}$")]
# Column and row in an image; the first pixel spans 0 … 1.
Pixel = tuple[FiniteFloat, FiniteFloat]
# Room for thousands of clicked episodes.
MAX_FILE_BYTES = 4 << 20
MAX_CLICKED = 10_000
# Objects of a task: slots of the state model and of the judge, where unused ones are masked.
MAX_OBJECTS = 3
DICTIONARY_SIZES: dict[MarkerDictionary, int] = {
    "DICT_4X4_50": 50,
    "DICT_5X5_250": 250,
    "DICT_6X6_250": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_36h11": 587,
}
_UNIT = 1e-3  # tolerance of typed numbers of three digits


def _is_turned(pose: Pose) -> Pose:
    norm = math.hypot(*pose[3:])
    if abs(norm - 1.0) > _UNIT:
        raise ValueError(f"got a quaternion (w x y z) of length {norm:.4g}, expected 1")
    return pose


class ObjectMarker(FrozenModel):
    """An ArUco or AprilTag marker on an object.

    `size_m` is the side of its black square; `pose` is T_object_marker, with x to the right and y
    upwards on the print and z out of it.
    """

    id: int = Field(ge=0, le=10_000)
    size_m: FiniteFloat = Field(gt=0.002, le=1.0)
    pose: Pose

    _pose_is_turned = field_validator("pose")(_is_turned)


class ClickedAt(FrozenModel):
    """How an object stands at the first step, so that clicks in its image give a pose.

    Attributes:
        up: axis that points up.
        heading: level axis, along which the second click lies.
        symmetric: whether the object looks the same from all sides around `up`, through the origin
            of its frame; it needs no second click, and `heading` counts as the world's x axis.
        point_m: the clicked point in the object's frame; by default the middle of the box's top.
        base_m: height of the lowest side of the box above the table.
    """

    up: Axis = "z"
    heading: Axis = "x"
    symmetric: bool = False
    point_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    base_m: FiniteFloat = 0.0

    @model_validator(mode="after")
    def _are_two_axes(self) -> "ClickedAt":
        if self.up[-1] == self.heading[-1]:
            raise ValueError(
                f"got up {self.up!r} and heading {self.heading!r}, expected different axes"
            )
        return self


class TouchedAt(FrozenModel):
    """How hands hold an object, or put another one on it, so that touch gives its pose.

    Touch counts in takes that succeeded; how the object stands before is as `click` says.

    Attributes:
        event: "grasp" for an object where it is held; one that is not fixed moves with the
            hand until it is let go. "release" for one where what was held is let go.
        hand: the hand that holds; both together if None, with the middle between their grips.
        point_m: the middle of the grip, in the object's frame; by default the middle of the box.
        closing_deg: of objects that are not symmetric, the angle, as seen from above and
            counterclockwise, from the axis `heading` to the direction from the thumb to the fingers
            (of both hands: from the left one to the right one).
    """

    event: Literal["grasp", "release"] = "grasp"
    hand: Literal["left", "right"] | None = None
    point_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    closing_deg: Annotated[FiniteFloat, Field(ge=-360, le=360)] | None = None


class SceneObject(FrozenModel):
    """One object of a task: its name, bounding box, and what measures its pose.

    `box_m` are centre and half sizes in the object's own frame. The pose comes from the `markers`
    as the head camera sees them or, if there are none, from the recorded stream `object_NAME` of a
    tracker, which sits on the object at `tracker_pose`, T_tracker_object. An object that is `fixed`
    stands still during a take: all sightings of its markers give one pose. `click` says how clicks
    in an episode's first image give a pose, where neither measured it, and `touch` how hands hold
    it, so that touch does.
    """

    name: ObjectName
    box_m: Box
    markers: tuple[ObjectMarker, ...] = Field(default=(), max_length=32)
    tracker_pose: Pose | None = None
    fixed: bool = False
    click: ClickedAt = Field(default=ClickedAt(), exclude_if=lambda click: click == ClickedAt())

    touch: TouchedAt | None = Field(default=None, exclude_if=is_none)

    _tracker_is_turned = field_validator("tracker_pose")(
        lambda pose: None if pose is None else _is_turned(pose)
    )

    @model_validator(mode="after")
    def _has_one_source(self) -> "SceneObject":
        if self.markers and self.tracker_pose is not None:
            raise ValueError(f"{self.name}: got markers and a tracker_pose, expected one of them")
        if min(self.box_m[3:]) <= 0:
            raise ValueError(
                f"{self.name}: got box_m with half sizes {self.box_m[3:]}, expected positive ones"
            )
        points = {"clicked": self.click.point_m, "touched": self.touch and self.touch.point_m}
        for what, point_m in points.items() if self.click.symmetric else ():
            place_m = point_m or self.box_m[:3]
            off_m = max(abs(place_m["xyz".index(axis)]) for axis in {*"xyz"} - {self.click.up[-1]})
            if off_m > _UNIT:
                raise ValueError(
                    f"{self.name}: got a symmetric object whose {what} point {place_m} is "
                    f"{off_m:.3g} m from its axis of symmetry, expected it there; shift its frame"
                )
        if self.touch and (self.touch.closing_deg is None) is not self.click.symmetric:
            raise ValueError(
                f"{self.name}: got touch.closing_deg {self.touch.closing_deg} and click.symmetric "
                f"{self.click.symmetric}, expected an angle where it is not symmetric, and none "
                "where it looks the same from all sides"
            )
        return self

    @field_validator("name")
    @classmethod
    def _is_no_other_stream(cls, name: str) -> str:
        if name == "poses":
            raise ValueError("got 'poses', whose stream would be that of the twin; choose another")
        return name

    @property
    def stream(self) -> str:
        """Name of the stream of its pose."""
        return object_stream(self.name)

    @property
    def is_carried(self) -> bool:
        """Whether a hand that touches it carries it."""
        return self.touch is not None and self.touch.event == "grasp" and not self.fixed


Objects = TypeVar("Objects", bound="SceneObjects")


class SceneObjects(FrozenModel):
    """Objects of every task, in the order of the world model's slots.

    `table_z_m` is the height of the table in the world, which clicks need.
    """

    dictionary: MarkerDictionary = Field(
        default="DICT_4X4_50", description="OpenCV's dictionary of the markers"
    )
    tasks: dict[
        Annotated[str, Field(min_length=1, max_length=128)],
        Annotated[tuple[SceneObject, ...], Field(min_length=1, max_length=MAX_OBJECTS)],
    ] = Field(description="objects of each task, as JSON")
    table_z_m: FiniteFloat = Field(
        default=0.0,
        exclude_if=lambda z_m: z_m == 0.0,
        description="height of the table in the world (m), which clicks on objects need",
    )

    @model_validator(mode="after")
    def _has_unique_names(self) -> "SceneObjects":
        for task, objects in self.tasks.items():
            names = [one.name for one in objects]
            ids = [marker.id for one in objects for marker in one.markers]
            for what, values in (("names", names), ("marker ids", ids)):
                if len(set(values)) != len(values):
                    raise ValueError(f"task {task!r}: got {what} {values}, expected different ones")
            held = [one.touch.hand for one in objects if one.touch and one.is_carried]
            if len(set(held)) != len(held):
                raise ValueError(
                    f"task {task!r}: several objects are grasped and carried by the same hand "
                    f"({', '.join(hand or 'both' for hand in held)}), whose holds touch cannot "
                    "tell apart; expected one a hand, or `fixed` for those that stay"
                )
            count = DICTIONARY_SIZES[self.dictionary]
            if max(ids, default=0) >= count:
                raise ValueError(
                    f"task {task!r}: got marker id {max(ids)}, expected 0 … {count - 1} of "
                    f"{self.dictionary}"
                )
        return self

    @classmethod
    def load(cls: type[Objects], path: Path) -> Objects:
        """Read the objects, and of `ObjectClicks` also the clicks, of a JSON file.

        Raises NotFoundError without the file, InvalidInputError if it is not JSON, too large, or
        has other fields than expected.
        """
        if not path.is_file():
            raise NotFoundError(f"objects: there is no file {path}; docs/objects.md shows one")
        if (num_bytes := path.stat().st_size) > MAX_FILE_BYTES:
            raise InvalidInputError(
                f"objects {path}: got {num_bytes} bytes, expected at most {MAX_FILE_BYTES}"
            )
        try:
            return cls.model_validate_json(path.read_bytes())
        except ValidationError as error:
            raise InvalidInputError(
                f"objects {path}: {first_problems(error)}; docs/objects.md shows a file"
            ) from error

    def of_task(self, task: str) -> "SceneObjects | None":
        """The objects of one task as streams measure them; None if the file does not have it.

        Without what only clicks and touch need: that does not change an episode.
        """
        if task not in self.tasks:
            return None
        listed = tuple(
            one.model_copy(update={"click": ClickedAt(), "touch": None}) for one in self.tasks[task]
        )
        return self.model_copy(update={"tasks": {task: listed}, "table_z_m": 0.0})


class ObjectClick(FrozenModel):
    """Where an object is in the image of an episode's first step.

    `point_px` is the image of its clicked point, `heading_px` a place farther along its heading at
    the same height. An object without them is `absent` from the scene, or `hidden` from the camera.
    """

    state: Literal["seen", "absent", "hidden"] = "seen"
    point_px: Pixel | None = None
    heading_px: Pixel | None = None

    @model_validator(mode="after")
    def _fits_the_state(self) -> "ObjectClick":
        is_seen = self.state == "seen"
        if (self.point_px is None) is is_seen or (self.heading_px is not None and not is_seen):
            raise ValueError(
                f"got state {self.state!r} with point_px {self.point_px} and heading_px "
                f"{self.heading_px}, expected a point_px if it is seen, and none otherwise"
            )
        return self


class EpisodeClicks(FrozenModel):
    """Clicks on the objects of one episode, by their names."""

    model_config = example(
        objects={"bottle": {"point_px": [31.5, 40.0], "heading_px": [36.0, 40.0]}}
    )

    objects: dict[ObjectName, ObjectClick] = Field(max_length=MAX_OBJECTS)


class ObjectClicks(SceneObjects):
    """Objects of the tasks, and clicks on them by episode.

    A file of objects alone is one without clicks.
    """

    version: Literal[1] = 1
    episodes: dict[StoreId, EpisodeClicks] = Field(default={}, max_length=MAX_CLICKED)


def object_stream(name: str) -> str:
    """Name of the stream of the pose T_world_object of an object."""
    return f"object_{name}"
