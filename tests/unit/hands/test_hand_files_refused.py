"""Models and mappings that describe no hand: the error names what and where."""

import pytest

from dextouch.errors import InvalidInputError
from dextouch.hands.hand_files import load_hand
from tests.unit.hands.hand_texts import FINGER_MAPPING as FINGER
from tests.unit.hands.hand_texts import FINGER_MJCF as MJCF
from tests.unit.hands.hand_texts import documented_mappings, four_finger_urdf, write_hand

URDF, MAPPING = four_finger_urdf(), documented_mappings()[1]


def refused(tmp_path, model, mapping, message, error=InvalidInputError):
    with pytest.raises(error, match=message) as caught:
        load_hand(*write_hand(tmp_path, model, mapping))
    assert str(caught.value)
    return str(caught.value)


def changed(text, old, new):
    """The text with its first `old` replaced; a pattern that is not there is the test's mistake."""
    assert old in text, old
    return text.replace(old, new, 1)


def test_the_sound_files_load(tmp_path):
    assert len(load_hand(*write_hand(tmp_path, URDF, MAPPING)).joint_names) == 16
    assert load_hand(*write_hand(tmp_path, MJCF, FINGER)).joint_names == (
        "abd",
        "flex",
        "pip",
        "dip",
    )


HINGE = '<limit lower="-0.47" upper="0.47" effort="1" velocity="7"/>'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<robot", "<machine", "invalid XML"),
        ('type="revolute"', 'type="prismatic"', "its type is 'prismatic'"),
        ('type="revolute"', 'type="continuous"', "its type is 'continuous'"),
        ('type="revolute"', 'type="hinge"', "'hinge'; valid: continuous, fixed"),
        ('type="revolute"', "", "got no 'type'"),
        (HINGE, f'{HINGE}<mimic joint="joint_1"/>', "it mimics another joint"),
        (HINGE, "", "joint_0.*no limits"),
        (HINGE, "<limit/>", "got limits 0.0 … 0.0 rad, expected lower < upper"),
        ('lower="-0.47"', 'lower="0.5"', "got limits 0.5 … 0.47 rad"),
        ('lower="-0.47"', 'lower="nan"', "lower='nan', expected 1 finite"),
        ('lower="-0.47"', 'lower="-90"', "are they degrees"),
        ('lower="-0.47"', 'lower="-1e999"', "expected 1 finite numbers"),
        ('lower="-0.47"', 'lower="-1_0"', "lower='-1_0'"),
        ('lower="-0.47"', 'lower=""', "lower='', expected 1"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "joint_0.*expected a direction"),
        ('xyz="0 0 2"', 'xyz="0 2"', "axis>: got xyz='0 2', expected 3 finite"),
        ('xyz="0 0 0.054"', 'xyz="0 0 54"', "lengths metres"),
        ('xyz="0 0 0.054"', 'xyz="0 0 inf"', "expected 3 finite numbers"),
        (
            'name="link_1"',
            'name="link_0"',
            "<link name='link_0'>: got this link",
        ),
        ('name="joint_1"', 'name="joint_0"', "got this joint twice"),
        (
            'child link="link_1"',
            'child link="link_0"',
            "'joint_0' already moves",
        ),
        ('child link="link_1"', 'child link="nothing"', "child link 'nothing'"),
        ('<parent link="palm"/>', "", "got no <parent>"),
        ('<parent link="palm"/>', '<parent link="palm"/>' * 2, "2 <parent>"),
        ('<link name="base"/>', "<link/>", "<link>: got no 'name'"),
        ('<link name="base"/>', '<xacro:macro name="m"/>', "got xacro"),
        ("joint_5", "joint_five", r"has \['joint_4', 'joint_five'"),
    ],
)
def test_broken_urdf_is_refused(old, new, message, tmp_path):
    said = refused(tmp_path, changed(URDF, old, new), MAPPING, message)
    assert "model.xml" in said or "mapping.toml" in said or "four_fingers" in said


END, SITE = "</default></default>", '<site name="tip" pos="0 0 -0.025"/>'
NEAR = '<body name="near"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="flex"', 'name="flex" type="slide"', "its type is 'slide'"),
        ('name="flex"', 'name="flex" type="ball"', "its type is 'ball'"),
        ('<joint name="flex"/>', "<freejoint/>", "its type is 'free'"),
        ('name="flex"', 'name="flex" limited="false"', "'flex'>: got no limits"),
        ('name="flex"', 'name="flex" limited="yes"', "'yes'; valid: auto"),
        ('name="flex"', 'name="flex" range="1 0"', "expected lower < upper"),
        ('name="flex"', 'name="flex" range="0 nan"', "expected 2 finite"),
        ('name="flex"', 'name="flex" range="0 1 2"', "expected 2 finite"),
        ('name="flex"', 'name="flex" range="0 90"', "are they degrees"),
        ('name="flex"', 'name="flex" axis="0 0 0"', "expected a direction"),
        ('name="flex"', 'name="flex" class="none"', "'none'; valid: hinge, main"),
        ('name="flex"', 'name="other"', r"has \['abd', 'other', 'pip', 'dip'\]"),
        ('<joint name="flex"/>', "<joint/>", r"has \['abd', '', 'pip'"),
        (' range="-0.5 1.5"', "", "got no limits"),
        ('angle="radian"', 'angle="grad"', "'grad'; valid: degree, radian"),
        ('angle="radian"', 'autolimits="false"', "autolimits is off"),
        ('angle="radian"', 'eulerseq="xyw"', "expected three of x y z"),
        ('angle="radian"', 'eulerseq="xy"', "expected three of x y z"),
        ('angle="radian"', 'coordinate="global"', "'global'; valid: local"),
        ('euler="0 0 0.1"', 'quat="0 0 0 0"', "mid'>.*is not a rotation"),
        ('euler="0 0 0.1"', 'xyaxes="1 0 0 2 0 0"', "is not a rotation"),
        ('euler="0 0 0.1"', 'xyaxes="0 0 0 2 0 0"', "is not a rotation"),
        ('euler="0 0 0.1"', 'zaxis="0 0 0"', "is not a rotation"),
        ('euler="0 0 0.1"', 'axisangle="0 0 0 1"', "is not a rotation"),
        ('euler="0 0 0.1"', 'euler="0 0 1" quat="1 0 0 0"', "quat and euler"),
        ('name="mid"', 'name="near"', "line 7: <body name='near'>: got this name"),
        ('name="mid"', 'name="world"', "reserved name"),
        ('active="false"', "", "an equality constraint couples it"),
        ('class="hinge">', ">", "<default>: got no 'class'"),
        (END, f'<default class="hinge"/>{END}', "'hinge' twice"),
        (SITE, '<site name="tip" fromto="0 0 0 0 0 1"/>', "got fromto"),
        (NEAR, f'<include file="/etc/passwd"/>{NEAR}', "<include>: got <include>"),
        ("<worldbody>", '<include file="other.xml"/><worldbody>', "mj_saveLastXML"),
        (NEAR, f'<attach model="m" body="b" prefix="p"/>{NEAR}', "one whole file"),
        (NEAR, f'<replicate count="9"/>{NEAR}', "one whole file"),
        (SITE, '<site name="tip"/><site name="tip"/>', "got this name twice"),
    ],
)  # fmt: skip
def test_broken_mjcf_is_refused(old, new, message, tmp_path):
    said = refused(tmp_path, changed(MJCF, old, new), FINGER, message)
    assert "model.xml" in said or "mapping.toml" in said or "finger" in said


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('side = "right"', 'side = "r"', "unknown side 'r'; valid: left, right"),
        ('side = "right"', "", "mapping.toml side: got none, expected one"),
        ('side = "right"', "side = 1", "mapping.toml side: got 1, expected: Input should be"),
        ('side = "right"', 'hand = "right"', "'hand'; valid: fingers, side"),
        ('side = "right"', 'side = "left"', "bend to the back of a left hand"),
        ('side = "right"', "side = ", "invalid TOML"),
        ('link = "wrist"', 'link = "nowhere"', "'nowhere'; valid: base, housing"),
        ('link = "wrist"', 'link = "index_tip"', r"between wrist and tip model.xml has \[\]"),
        ('link = "wrist"', 'link = "link_15"', "does not hang on the wrist link 'link_15'"),
        ('link = "wrist"', "", "got none, expected one of link, body"),
        ('link = "wrist"', 'link = "wrist"\nbody = "wrist"', "link and body"),
        ("fingers_along = [0, 0, 1]", "fingers_along = [0, 0]", "three finite"),
        ("fingers_along = [0, 0, 1]", "fingers_along = [0, 0, 0]", "of zeros"),
        ("fingers_along = [0, 0, 1]", "fingers_along = [0, 0, nan]", "finite"),
        ("fingers_along = [0, 0, 1]", f"fingers_along = [0, 0, {10**400}]", "finite"),
        ("fingers_along = [0, 0, 1]", "fingers_along = [0, 0, true]", "finite"),
        ("fingers_along = [0, 0, 1]", "fingers_along = [0, 1, 1]", "45.00°, exp"),
        ("thumb_side = [0, 1, 0]", "thumb_side = [0, -1, 0]", "fall from index"),
        ('chain = "index"', 'chain = "pointer"', "'pointer'; valid: index"),
        ('chain = "index"', 'chain = "middle"', "chain 'middle' appears twice"),
        ('"joint_0", "joint_1"', '"joint_1", "joint_0"', "list exactly those"),
        ('"joint_0", ', "", "list exactly those, from the wrist outwards"),
        ('"joint_0", ', "0, ", "fingers.0.joints.0: got 0, expected: Input should be"),
        ('knuckle = "joint_1"', 'knuckle = "joint_9"', "unknown knuckle of"),
        ('knuckle = "joint_1"', 'knuckle = "joint_3"', r"got hinges \(3, 2, 3\)"),
        ('tip = { link = "index_tip" }', 'tip = "index_tip"', "expected a table"),
        ('link = "index_tip"', 'link = "x"', "unknown link in .*tip"),
        ('link = "index_tip"', 'site = "index_tip"', "site in .*'index' tip.*valid: none"),
        ('link = "index_tip"', 'link = "ring_tip"', "has .'joint_8'"),
        ('link = "index_tip"', 'link = "base"', r"has \[\]"),
    ],
)  # fmt: skip
def test_mistaken_mappings_are_refused(old, new, message, tmp_path):
    refused(tmp_path, URDF, changed(MAPPING, old, new), message)


@pytest.mark.parametrize("fingers", ["fingers = []", "fingers = 3", "fingers = [3]", ""])
def test_mappings_without_fingers_are_refused(fingers, tmp_path):
    head = MAPPING.partition("[[fingers]]")[0]
    refused(tmp_path, URDF, f"{fingers}\n{head}", "finger")


def test_links_in_a_ring_are_refused(tmp_path):
    ring = changed(
        URDF,
        '<parent link="palm"/><child link="link_0"/>',
        '<parent link="link_3"/><child link="link_0"/>',
    )
    refused(tmp_path, ring, MAPPING, "form a ring at")
    fixed = changed(URDF, '<parent link="base"/>', '<parent link="wrist"/>')
    assert load_hand(*write_hand(tmp_path, fixed, MAPPING)).joint_names
