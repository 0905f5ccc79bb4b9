"""Texts of hands for tests: the mappings of docs/hands.md, the maker's MJCF, a four-finger URDF."""

import importlib.metadata
import re
from pathlib import Path

import pytest

# One finger, with what matters in MJCF: default classes, an orientation, a drawn angle, a site.
FINGER_MJCF = """<mujoco model="finger">
<compiler angle="radian"/>
<default><joint axis="1 0 0"/><default class="hinge"><joint range="-0.5 1.5"/></default></default>
<worldbody>
<body name="palm" childclass="hinge">
<body name="near" pos="0 0 -0.09"><joint name="abd" axis="0 1 0"/><joint name="flex"/>
<body name="mid" pos="0 0 -0.04" euler="0 0 0.1"><joint name="pip"/>
<body name="far" pos="0 0 -0.03"><joint name="dip" ref="0.1"/>
<site name="tip" pos="0 0 -0.025"/>
</body></body></body></body>
</worldbody>
<equality><joint joint1="pip" joint2="dip" active="false"/></equality>
</mujoco>"""
FINGER_MAPPING = """side = "right"
[wrist]
body = "palm"
fingers_along = [0, 0, -1]
thumb_side = [1, 0, 0]
[[fingers]]
chain = "index"
joints = ["abd", "flex", "pip", "dip"]
knuckle = "flex"
pip = "pip"
dip = "dip"
tip = { site = "tip" }
"""
DOCUMENT = Path(__file__).parents[3] / "docs" / "hands.md"


def documented_mappings():
    """The Wuji hand's mapping and the four-finger hand's."""
    text = DOCUMENT.read_text(encoding="utf-8")
    wuji, four = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    return wuji, four


def wuji_mapping(side):
    right = documented_mappings()[0]
    return right if side == "right" else right.replace('"r_', '"l_').replace('"right"', '"left"')


def official_model(side):
    """The maker's MJCF; skips where the package is not installed."""
    try:
        package = importlib.metadata.distribution("aiowuji")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("needs the maker's MJCF: pip install --no-deps aiowuji==0.1.0")
    return Path(str(package.locate_file(f"aiowuji/models/wuji_hand2/mjcf/{side}.xml")))


def write_hand(folder, model, mapping):
    """Model and mapping as files; texts or bytes."""
    paths = folder / "model.xml", folder / "mapping.toml"
    for path, content in zip(paths, (model, mapping), strict=True):
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return paths


def _hinge(number, parent, origin, axis, limits):
    lower, upper = limits
    return (
        f'<link name="link_{number}"/><joint name="joint_{number}" type="revolute">'
        f'<parent link="{parent}"/><child link="link_{number}"/><origin {origin}/>'
        f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}" effort="1" velocity="7"/>'
        "</joint>"
    )


def _fixed(parent, child, origin):
    return (
        f'<link name="{child}"/><joint name="{parent}_{child}" type="fixed">'
        f'<parent link="{parent}"/><child link="{child}"/><origin {origin}/></joint>'
    )


def _finger(chain, first, palm_origin):
    # A motor's housing stands between two hinges: a fixed step that must be folded.
    return "".join(
        [
            _hinge(first, "palm", palm_origin, "0 0 2", (-0.47, 0.47)),
            _fixed(f"link_{first}", f"housing_{chain}", 'xyz="0 0 0.01" rpy="0.1 0 0.2"'),
            _hinge(first + 1, f"housing_{chain}", 'xyz="0 0 0.0064"', "0 1 0", (-0.196, 1.61)),
            _hinge(first + 2, f"link_{first + 1}", 'xyz="0 0 0.054"', "0 1 0", (-0.174, 1.709)),
            _hinge(first + 3, f"link_{first + 2}", 'xyz="0 0 0.0384"', "0 1 0", (-0.227, 1.618)),
            _fixed(f"link_{first + 3}", f"{chain}_tip", 'xyz="0 0 0.0387"'),
        ]
    )


def four_finger_urdf():
    """Three fingers and a thumb, made up in the manner of the Allegro Hand, with its sizes."""
    thumb_origin = 'xyz="-0.0182 0.0193 -0.046" rpy="0 -1.658 -1.5708"'
    return "\n".join(
        [
            '<?xml version="1.0"?><robot name="four_fingers"><link name="base"/>',
            _fixed("base", "palm", 'xyz="0.01 0 0.05" rpy="0 0 0.3"'),
            _fixed("palm", "wrist", 'xyz="0 0 -0.095" rpy="0 0 0"'),
            _finger("index", 0, 'xyz="0 0.0435 -0.0015" rpy="-0.0873 0 0"'),
            _finger("middle", 4, 'xyz="0 0 0.0007"'),
            _finger("ring", 8, 'xyz="0 -0.0435 -0.0015" rpy="0.0873 0 0"'),
            _hinge(12, "palm", thumb_origin, "-1 0 0", (0.263, 1.396)),
            _hinge(13, "link_12", 'xyz="-0.027 0.005 0.0399"', "0 0 1", (-0.105, 1.163)),
            _hinge(14, "link_13", 'xyz="0 0 0.0177"', "0 1 0", (-0.189, 1.644)),
            _hinge(15, "link_14", 'xyz="0 0 0.0514"', "0 1 0", (-0.162, 1.719)),
            "</robot>",
        ]
    )
