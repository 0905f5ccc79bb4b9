"""Mapping from the features of any LeRobot dataset to the streams of an episode."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.source import DatasetInfo, FeatureInfo
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM
from dextouch.tactile.layout import NUM_TAXELS

FLOATS = ("float32", "float64")
ACTION, STATE, TACTILE = "action", "state", "tactile"
HEAD = "camera_head"
_CAMERA_NAME = re.compile(r"camera_[a-z0-9_]{1,57}")
_DEFAULTS = {ACTION: layout.ACTION, STATE: layout.STATE, TACTILE: layout.TACTILE}
_SHAPES = {ACTION: (ACTION_DIM,), STATE: (ACTION_DIM,), TACTILE: (2, NUM_TAXELS)}


@dataclass(frozen=True)
class FeatureMap:
    """Feature names by role; None where the dataset has no such feature."""

    action: str
    state: str | None
    tactile: str | None
    cameras: dict[str, str]


def map_features(info: DatasetInfo, names: Mapping[str, str]) -> FeatureMap:
    """Find the features of an episode.

    Args:
        info: of the dataset.
        names: our name → the dataset's feature, for features under other names: `action`,
            `state`, `tactile` and cameras (`camera_head`, `camera_wrist_left`, …).

    Raises:
        UnknownNameError: an unknown name of ours, or a feature that the dataset lacks.
        InvalidInputError: required features that are missing or have another shape; all are listed,
            with what the dataset has.
    """
    for ours, theirs in names.items():
        if ours not in _DEFAULTS and not _CAMERA_NAME.fullmatch(ours):
            raise UnknownNameError("name of a mapping", ours, [*_DEFAULTS, "camera_…"])
        if theirs not in info.features:
            raise UnknownNameError("feature of the dataset", theirs, list(info.features))
    cameras = _cameras(info, names)
    found = {n: names.get(n, default) for n, default in _DEFAULTS.items()}
    problems = [
        problem
        for ours, feature in found.items()
        if (problem := _problem(info, ours, feature, needed=ours == ACTION or ours in names))
    ]
    if HEAD not in cameras:
        problems.append(f"{HEAD!r}: no video feature {layout.IMAGES + HEAD!r}")
    problems += [
        f"{ours!r}: {feature!r} is {_describe(info.features[feature])}, expected video [h, w, 3]"
        for ours, feature in cameras.items()
        if not _is_video(info.features[feature])
    ]
    if problems:
        has = "; ".join(f"{name!r} {_describe(f)}" for name, f in info.features.items())
        raise InvalidInputError(
            f"LeRobot dataset does not fit: {'; '.join(problems)}. It has: {has}. Name the right "
            "ones, for example mapping={'camera_head': 'observation.images.top'}",
            missing=problems,
        )
    fits = {n: f for n, f in found.items() if not _problem(info, n, f, needed=True)}
    return FeatureMap(fits[ACTION], fits.get(STATE), fits.get(TACTILE), cameras)


def _cameras(info: DatasetInfo, names: Mapping[str, str]) -> dict[str, str]:
    """Cameras under our own names, and those given by the mapping."""
    taken = set(names.values())
    cameras = {
        name.removeprefix(layout.IMAGES): name
        for name, feature in info.features.items()
        if name.startswith(layout.IMAGES)
        and _CAMERA_NAME.fullmatch(name.removeprefix(layout.IMAGES))
        and feature.dtype == "video"
        and name not in taken
    }
    return cameras | {n: f for n, f in names.items() if n not in _DEFAULTS}


def _problem(info: DatasetInfo, ours: str, feature: str, *, needed: bool) -> str | None:
    shape = _SHAPES[ours]
    if feature not in info.features:
        return f"{ours!r}: no feature {feature!r}" if needed else None
    got = info.features[feature]
    if got.dtype in FLOATS and got.numbers() == shape:
        return None
    wanted = f"float32 {list(shape)}"
    return f"{ours!r}: {feature!r} is {_describe(got)}, expected {wanted}" if needed else None


def _is_video(feature: FeatureInfo) -> bool:
    shape = feature.numbers()
    return feature.dtype == "video" and len(shape) == 3 and shape[2] == 3 and min(shape) > 0


def _describe(feature: FeatureInfo) -> str:
    return f"{feature.dtype} {list(feature.shape)}"
