"""Layout of Foxglove's panels for the streams of MCAP exports: cameras, touch, joints, 3D, actions.

The form is that of layouts which the app itself exports and imports ("Import from file").
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from dextouch.bridges.export_files import new_file, touch_side
from dextouch.bridges.mcap_messages import ACTION, ACTIONS, MessageCodec, joint_names
from dextouch.streams import HEAD_CAMERA, StreamDescriptor

LAYOUT_FILE: Final = "foxglove_layout.json"
SPACE: Final = "3D!world"
# Joints that show how far a finger is closed.
CLOSING: Final = ("_cmc_flex", "_mcp_flex")
# A layout of a panel, or of two with the share of the first.
Tree = str | dict[str, Any]


def foxglove_layout(streams: Iterable[StreamDescriptor]) -> dict[str, Any]:
    """Panels for these streams, as JSON values; where several have one name, for the last."""
    known = list({stream.name: stream for stream in streams}.values())
    cameras = {f"Image!{s.name}": _image(s) for s in known if s.kind == "image"}
    touch = {
        f"Image!{s.name}": _image(s, "/image")
        for s in known
        if s.kind == "tactile" and touch_side(s)
    }
    plots = {f"Plot!{name}": _plot(paths) for name, paths in _curves(known).items() if paths}
    shown = {f"/{s.name}": {"visible": True} for s in known if s.kind == "pose"}
    space = {
        SPACE: {
            "followMode": "follow-none",
            "followTf": "world",
            "topics": shown,
            "layers": {"grid": {"layerId": "foxglove.Grid", "instanceId": "grid", "size": 2}},
        }
    }
    below = [_split([SPACE], "row")]
    below += [_split(list(group), "column") for group in (touch, plots) if group]
    rows = [_split(list(cameras), "row")] if cameras else []
    return {
        "configById": cameras | touch | plots | space,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split([*rows, _split(below, "row")], "column"),
    }


def write_layout(path: Path, streams: Iterable[StreamDescriptor]) -> None:
    """Write a layout for these streams, in place of an existing file; raises StorageError."""
    with new_file(path, overwrite=True) as partial:
        partial.write_text(json.dumps(foxglove_layout(streams), indent=1), encoding="utf-8")


def _split(parts: Sequence[Tree], direction: str) -> Tree:
    """Parts of equal size, side by side ("row") or one above the other ("column")."""
    if len(parts) == 1:
        return parts[0]
    return {
        "direction": direction,
        "first": parts[0],
        "second": _split(parts[1:], direction),
        "splitPercentage": 100 / len(parts),
    }


def _image(stream: StreamDescriptor, below: str = "") -> dict[str, Any]:
    mode = {"imageTopic": f"/{stream.name}{below}"}
    if stream.name == HEAD_CAMERA:
        mode["calibrationTopic"] = f"/{HEAD_CAMERA}/calibration"
    return {"imageMode": mode}


def _curves(streams: Sequence[StreamDescriptor]) -> dict[str, list[tuple[str, str]]]:
    """Labels and message paths of the plots: how far fingers are closed, and how hands move."""
    joints = [
        (f"{stream.name} {name}", f'/{stream.name}.joints[:]{{name=="{name}"}}.position')
        for stream in streams
        for name in joint_names(stream)
        if name.endswith(CLOSING)
    ]
    actions = [
        (f"{stream.name} {side} {axis}", f"/{stream.name}.wrist_{side}[{index}]")
        for stream in streams
        if stream.name in ACTIONS[:1] and MessageCodec(stream).message == ACTION
        for side in ("left", "right")
        for index, axis in enumerate("xyz")
    ]
    return {"joints": joints, "action": actions}


def _plot(paths: Sequence[tuple[str, str]]) -> dict[str, Any]:
    series = [
        {"label": label, "value": path, "enabled": True, "timestampMethod": "receiveTime"}
        for label, path in paths
    ]
    return {"paths": series, "showLegend": True, "isSynced": True}
