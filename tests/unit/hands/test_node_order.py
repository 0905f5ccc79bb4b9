"""Nodes of a tracked hand are found by what they are called or hang on, in any order."""

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
    TreeNode,
    node_order,
    nodes_of_tree,
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


def tree_of(chains, rng, *, num_metacarpals=4):
    """A hand tree with random ids in random order, and what each node truly is."""
    ids = iter(rng.permutation(1000)[:NUM_KEYPOINTS].tolist())
    root = next(ids)
    nodes, truth = [TreeNode(root, root)], {root: (WRIST, WRIST)}
    for chain in chains:
        ours = "little" if chain == "pinky" else chain
        joints = joints_of(ours)
        parent = root
        for joint in joints if chain == "thumb" or num_metacarpals else joints[1:]:
            node_id = next(ids)
            nodes.append(TreeNode(node_id, parent, chain if joint == "tip" else None))
            truth[node_id], parent = (ours, joint), node_id
    order = rng.permutation(len(nodes))
    return [nodes[index] for index in order], truth


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


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("chains", [LINUX_CHAINS, WINDOWS_CHAINS])
def test_a_tree_of_opaque_ids_gives_the_nodes(chains, seed):
    tree, truth = tree_of(chains, np.random.default_rng(seed))
    nodes = nodes_of_tree(tree)
    assert nodes == [truth[node.id] for node in tree]
    assert sorted(node_order(nodes).places) == list(range(NUM_KEYPOINTS))


def test_a_tree_may_begin_at_the_knuckles():
    tree, truth = tree_of(WINDOWS_CHAINS, np.random.default_rng(1), num_metacarpals=0)
    nodes = nodes_of_tree(tree)
    assert nodes == [truth[node.id] for node in tree]
    assert node_order(nodes, may_lack=FINGER_METACARPALS).absent == FINGER_METACARPALS


def test_broken_trees_are_refused():
    tree, truth = tree_of(WINDOWS_CHAINS, np.random.default_rng(2))
    place = {truth[node.id]: index for index, node in enumerate(tree)}

    def with_node(name, **changes):
        nodes = list(tree)
        old = nodes[place[name]]
        nodes[place[name]] = TreeNode(**{**vars(old), **changes})
        return nodes

    ids = {name: tree[index].id for name, index in place.items()}
    broken = {
        "roots": with_node(("ring", "distal"), parent=None),
        "different ids": with_node(("ring", "tip"), id=ids["ring", "distal"]),
        "has the children": with_node(("ring", "tip"), parent=ids["ring", "intermediate"]),
        r"called \['little', 'thumb'\]": with_node(
            ("thumb", "metacarpal"), parent=ids["little", "tip"]
        ),
        "do not lead back": with_node(("ring", "metacarpal"), parent=ids["ring", "tip"]),
        "called nothing": with_node(("ring", "tip"), chain=None),
        r"called \['index', 'ring'\]": with_node(("ring", "distal"), chain="index"),
        "has 5 nodes": with_node(("ring", "tip"), chain="thumb"),
        "'tail'": with_node(("ring", "tip"), chain="tail"),
    }
    for words, nodes in broken.items():
        with pytest.raises(InvalidInputError, match=words):
            nodes_of_tree(nodes)
    # A chain that is there twice is for `node_order` to see.
    with pytest.raises(InvalidInputError, match=r"missing .*'ring', 'tip'"):
        node_order(nodes_of_tree(with_node(("ring", "tip"), chain="middle")))
