"""Unit, order of nodes and side of tracked hands are recognised by the hand itself."""

from itertools import permutations, product

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.hands import (
    CHAINS,
    METACARPAL_NODES,
    NODE_INDEX,
    PALM_NODES,
    chain_indices,
    mean_hand_m,
)
from services.alignment.retargeting.hand_checks import check_hand_shape, check_handedness
from services.twin.hands import HumanHand
from tests.unit.alignment.tracked_hands import (
    any_rotation,
    flat_hand,
    moving_hand,
    of_another_person,
)

SIDES = ("left", "right")


def tracked(side, seed, *, make=moving_hand, noise_m=1e-3):
    """A person's hand in axes of the tracker."""
    rng = np.random.default_rng(seed)
    keypoints = of_another_person(make(side, rng), rng)
    keypoints += rng.normal(scale=noise_m, size=keypoints.shape)
    return keypoints @ any_rotation(rng).T + rng.normal(size=3)


@pytest.mark.parametrize("side", SIDES)
def test_the_mean_hand_has_the_axes_of_the_twins_people(side):
    twin = HumanHand(side).keypoints_m(np.zeros((1, 20)))[0]
    ours = mean_hand_m(side)
    fingers = [node for chain in CHAINS[1:] for node in chain_indices(chain)]
    np.testing.assert_allclose(ours[fingers], twin[fingers], atol=1e-12)
    thumb = chain_indices("thumb")
    np.testing.assert_allclose(ours[thumb[0]], twin[thumb[0]], atol=1e-12)
    lengths = [np.linalg.norm(np.diff(hand[thumb], axis=0), axis=1) for hand in (ours, twin)]
    np.testing.assert_allclose(*lengths, atol=1e-12)
    with pytest.raises(UnknownNameError):
        mean_hand_m("both")


@pytest.mark.long
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("make", [moving_hand, flat_hand])
def test_hands_of_people_are_taken(side, make):
    for seed in range(12):
        for noise_m in (1e-3, 3e-3):
            keypoints = tracked(side, seed, make=make, noise_m=noise_m)
            assert 0.6 < check_hand_shape(keypoints) < 1.4
            assert check_handedness(keypoints, side) in (side, None)
            # As a tracker of 21 nodes sees it.
            keypoints[:, METACARPAL_NODES] = np.nan
            check_hand_shape(keypoints)
            check_handedness(keypoints, side)


@pytest.mark.parametrize(
    ("factor", "name"), [(1e3, "millimetres"), (1e2, "centimetres"), (1 / 0.0254, "inches")]
)
def test_other_units_are_named(factor, name):
    with pytest.raises(InvalidInputError, match=f"these look like {name}") as refusal:
        check_hand_shape(tracked("right", 1) * factor, where="keypoints_right")
    assert refusal.value.details == {"fault": "unit", "found": name}
    assert refusal.value.message.startswith("keypoints_right: got a hand ")


def test_a_size_that_no_unit_explains_is_refused():
    with pytest.raises(InvalidInputError, match="no unit that we know"):
        check_hand_shape(tracked("right", 1) * 7.0)


def order(chains, *, is_turned=False, is_wrist_last=False):
    nodes = []
    for chain in chains:
        nodes += chain_indices(chain)[::-1] if is_turned else chain_indices(chain)
    return [*nodes, 0] if is_wrist_last else [0, *nodes]


@pytest.mark.parametrize("seed", range(4))
def test_other_orders_are_named(seed):
    keypoints = tracked("left", seed)
    linux = ("little", "thumb", "index", "ring", "middle")
    cases = {
        "wrist, little, thumb, index, ring, middle": order(linux),
        "wrist, thumb, index, middle, little, ring": order(
            ("thumb", "index", "middle", "little", "ring")
        ),
        "wrist, index, middle, ring, little, thumb": order((*CHAINS[1:], "thumb")),
        "thumb, index, middle, ring, little, wrist": order(CHAINS, is_wrist_last=True),
        "wrist, thumb, index, middle, ring, little, each from the tip to the metacarpal": order(
            CHAINS, is_turned=True
        ),
    }
    for name, nodes in cases.items():
        with pytest.raises(InvalidInputError, match=f"another order: {name}") as refusal:
            check_hand_shape(keypoints[:, nodes])
        assert refusal.value.details == {"fault": "node_order", "found": name}
    # Both at once: the order comes first, since sizes of mixed bones mean nothing.
    with pytest.raises(InvalidInputError, match="another order: wrist, little, thumb"):
        check_hand_shape(keypoints[:, order(linux)] * 1e3)


@pytest.mark.long
def test_every_order_of_chains_and_joints_is_named():
    keypoints = tracked("right", 7)[:20]
    num_orders = 0
    for chains in permutations(CHAINS):
        for is_turned, is_wrist_last in product((False, True), repeat=2):
            nodes = order(chains, is_turned=is_turned, is_wrist_last=is_wrist_last)
            if nodes == list(range(25)):
                continue
            num_orders += 1
            with pytest.raises(InvalidInputError) as refusal:
                check_hand_shape(keypoints[:, nodes])
            found = refusal.value.details["found"]
            names = [*chains, "wrist"] if is_wrist_last else ["wrist", *chains]
            assert found.startswith(", ".join(names))
            assert found.endswith("to the metacarpal") is is_turned
    assert num_orders == 479


@pytest.mark.parametrize("seed", range(4))
def test_a_hand_one_joint_off_is_named(seed):
    keypoints = tracked("right", seed)
    shifted = keypoints.copy()
    for chain in CHAINS:
        nodes = chain_indices(chain)
        shifted[:, nodes[1:]] = keypoints[:, nodes[:-1]]
    with pytest.raises(InvalidInputError, match="one joint off"):
        check_hand_shape(shifted)


@pytest.mark.long
@pytest.mark.parametrize("make", [moving_hand, flat_hand])
@pytest.mark.parametrize("side", SIDES)
def test_the_other_hand_is_recognised_and_named(side, make):
    other = "left" if side == "right" else "right"
    num_found = 0
    for seed in range(20):
        keypoints = tracked(side, seed, make=make)
        found = check_handedness(keypoints, side)
        if make is moving_hand:
            assert found == side
        if found is None:
            continue
        num_found += 1
        with pytest.raises(InvalidInputError, match=f"got a {side} hand, expected a {other}") as e:
            check_handedness(keypoints, other)
        assert e.value.details == {"fault": "side", "found": side}
        # A mirror image is the other hand.
        with pytest.raises(InvalidInputError, match=f"got a {other} hand"):
            check_handedness(keypoints * [1, 1, -1], side)
    # A flat hand shows its side only by the base of the thumb.
    assert num_found >= 18


def test_a_flat_hand_without_thumb_shows_no_side():
    keypoints = tracked("left", 3, make=flat_hand)
    keypoints[:, NODE_INDEX["thumb", "metacarpal"]] = np.nan
    for side in SIDES:
        assert check_handedness(keypoints, side) is None


def test_what_is_no_hand_is_refused():
    rng = np.random.default_rng(0)
    for points in (rng.normal(scale=0.05, size=(30, 25, 3)), np.zeros((30, 25, 3))):
        with pytest.raises(InvalidInputError) as refusal:
            check_hand_shape(points)
        assert refusal.value.details["fault"] == "no_hand"
    with pytest.raises(ShapeError, match="25, 3"):
        check_hand_shape(np.zeros((3, 21, 3)))
    with pytest.raises(ShapeError, match="25, 3"):
        check_handedness(np.zeros((0, 25, 3)), "left")


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf, 1e300])
def test_nodes_that_are_no_places_do_not_count(nothing):
    keypoints = tracked("right", 5)
    clean = check_hand_shape(keypoints[:40]), check_handedness(keypoints[:40], "right")
    keypoints[40:, :, 1] = nothing
    assert (check_hand_shape(keypoints), check_handedness(keypoints, "right")) == clean
    keypoints[:, PALM_NODES[:6]] = nothing
    with pytest.raises(InvalidInputError, match="at most 3 of the 9 nodes") as refusal:
        check_hand_shape(keypoints)
    assert refusal.value.details == {"fault": "unseen"}
