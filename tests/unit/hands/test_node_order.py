"""Nodes of a tracked hand are found by what they are called, in any order."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands import (
    CHAINS,
    FINGER_JOINTS,
    FINGER_METACARPALS,
    NODE_INDEX,
    NODES,
    NUM_KEYPOINTS,
    WRIST,
    node_order,
)
from dextouch.hands.skeleton import THUMB_JOINTS

ORDERS = st.permutations(range(NUM_KEYPOINTS))
LINUX_CHAINS = ("pinky", "thumb", "index", "ring", "middle")
WINDOWS_CHAINS = ("thumb", "index", "middle", "ring", "pinky")
MEDIAPIPE = [
    ("wrist", "wrist"),
    *[("THUMB", joint) for joint in ("CMC", "MCP", "IP", "TIP")],
    *[
        (chain, joint)
        for chain in ("INDEX", "MIDDLE", "RING", "PINKY")
        for joint in ("MCP", "PIP", "DIP", "TIP")
    ],
]
OPENXR = [
    ("palm", "palm"),
    ("wrist", "wrist"),
    *[("thumb", joint) for joint in THUMB_JOINTS],
    *[(chain, joint) for chain in CHAINS[1:] for joint in FINGER_JOINTS],
]


def joints_of(chain):
    return THUMB_JOINTS if chain == "thumb" else FINGER_JOINTS


def manus_ros2(chains):
    """The words that MANUS's ROS 2 node publishes, whose "MCP" is the metacarpal's base."""
    words = dict(zip(FINGER_JOINTS, ("MCP", "PIP", "IP", "DIP", "TIP"), strict=True))
    fingers = [(c.title(), words[j]) for c in chains for j in joints_of(c)]
    return [("Hand", "Invalid"), *fingers]


@given(ORDERS)
def test_any_order_of_our_names(order):
    found = node_order([NODES[index] for index in order])
    assert found.places == tuple(order)
    assert found.absent == ()
    points = np.random.default_rng(0).normal(size=(2, NUM_KEYPOINTS, 3))
    np.testing.assert_array_equal(found.keypoints(points[:, order]), points)


@pytest.mark.parametrize("chains", [LINUX_CHAINS, WINDOWS_CHAINS])
def test_manus_nodes_of_both_systems_go_to_the_right_bones(chains):
    named = [(WRIST, WRIST), *[(c, j) for c in chains for j in joints_of(c)]]
    expected = tuple(NODE_INDEX["little" if c == "pinky" else c, j] for c, j in named)
    assert node_order(named).places == expected
    # The same hand by the words of the ROS 2 node, which are one joint off.
    assert node_order(manus_ros2(chains)).places == expected


def test_openxr_has_a_palm_that_is_left_out():
    found = node_order(OPENXR)
    assert found.places == (-1, *range(NUM_KEYPOINTS))
    points = np.arange(26 * 3.0).reshape(26, 3)
    np.testing.assert_array_equal(found.keypoints(points), points[1:])


def test_mediapipe_lacks_the_bones_of_the_palm():
    with pytest.raises(InvalidInputError, match="'index', 'metacarpal'") as refusal:
        node_order(MEDIAPIPE)
    assert refusal.value.details["missing"] == list(FINGER_METACARPALS)
    found = node_order(MEDIAPIPE, may_lack=FINGER_METACARPALS)
    assert found.absent == FINGER_METACARPALS
    names = [NODES[place] for place in found.places]
    assert names[1:7] == [
        ("thumb", "metacarpal"),
        ("thumb", "proximal"),
        ("thumb", "distal"),
        ("thumb", "tip"),
        ("index", "proximal"),
        ("index", "intermediate"),
    ]
    keypoints = found.keypoints(np.ones((3, 21, 3)))
    is_absent = np.isnan(keypoints).all(axis=(0, 2))
    assert {NODES[index] for index in np.flatnonzero(is_absent)} == set(FINGER_METACARPALS)
    with pytest.raises(ShapeError, match=r"21, 3"):
        found.keypoints(np.ones((3, 25, 3)))


@given(ORDERS, st.integers(0, 24), st.integers(0, 24))
def test_missing_and_repeated_nodes_are_named(order, place, other):
    nodes = [NODES[index] for index in order]
    if place == other:
        return
    missing, nodes[place] = nodes[place], nodes[other]
    with pytest.raises(InvalidInputError) as refusal:
        node_order(nodes)
    assert refusal.value.details["missing"] == [missing]
    assert refusal.value.details["twice"] == [nodes[other]]


@pytest.mark.parametrize(
    "node", [("thumb", "intermediate"), ("index", "mcp"), ("tail", "tip"), ("wrist", "tip")]
)
def test_unknown_nodes_are_named_as_the_tracker_calls_them(node):
    with pytest.raises(InvalidInputError, match="unknown") as refusal:
        node_order([*NODES, node])
    assert refusal.value.details["unknown"] == [node]


def test_half_translated_words_are_refused():
    nodes = [(c, "mcp" if (c, j) == ("ring", "proximal") else j) for c, j in NODES]
    with pytest.raises(InvalidInputError, match=r"unknown \[\('ring', 'mcp'\)\]"):
        node_order(nodes)
