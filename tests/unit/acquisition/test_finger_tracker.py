"""Nodes of a finger tracker are told apart by chain and joint, never by their place."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import DeviceError, PacketError
from dextouch.hands import NODE_INDEX, NODES, NUM_KEYPOINTS
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.finger_tracker import (
    ALL_SEEN,
    CHAIN_IDS,
    JOINT_IDS,
    VALIDITY,
    FingerTracker,
    FingerTrackerDecoder,
    parse_node_order,
    resolve_nodes,
    unpack_keypoints,
)
from services.acquisition.mocks.ports import HidPort
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.mocks.trackers_and_cameras import FingerTrackerSource

ORDERS = st.permutations(range(NUM_KEYPOINTS))


def node_bytes(nodes):
    return bytes(number for c, j in nodes for number in (CHAIN_IDS[c], JOINT_IDS[j]))


def points_of(seed=0):
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (NUM_KEYPOINTS, 3)).astype(np.float32)


def source(seed=1, samples=6):
    values = np.stack([points_of(index) for index in range(samples)]).astype(np.float64)
    descriptor = StreamDescriptor(
        name="keypoints_left",
        kind="keypoints",
        shape=(NUM_KEYPOINTS, 3),
        dtype="float64",
        unit="m",
        nominal_rate_hz=120,
    )
    stream = ReplayStream(descriptor, np.arange(samples, dtype=np.int64), values)
    rng = np.random.default_rng(seed)
    return FingerTrackerSource(stream, side="left", rng=rng), values


@given(ORDERS)
def test_any_order_gives_the_same_hand(order):
    nodes = [NODES[index] for index in order]
    assert resolve_nodes(nodes) == list(order)
    assert parse_node_order(node_bytes(nodes)) == list(order)
    points = points_of()
    payload = VALIDITY.pack(ALL_SEEN) + points[order].tobytes()
    keypoints, num_unseen = unpack_keypoints(payload, np.array(order))
    np.testing.assert_array_equal(keypoints, points)
    assert num_unseen == 0


@given(ORDERS, st.sets(st.integers(0, NUM_KEYPOINTS - 1)))
def test_unseen_nodes_follow_their_ids(order, unseen_places):
    bits = ALL_SEEN & ~sum(1 << place for place in unseen_places)
    payload = VALIDITY.pack(bits) + points_of()[order].tobytes()
    keypoints, num_unseen = unpack_keypoints(payload, np.array(order))
    unseen = set(np.flatnonzero(np.isnan(keypoints).any(axis=1)))
    assert unseen == {order[place] for place in unseen_places}
    assert num_unseen == len(unseen_places)


@given(ORDERS, st.integers(0, NUM_KEYPOINTS - 1), st.integers(0, NUM_KEYPOINTS - 1))
def test_a_node_twice_is_refused_and_both_are_named(order, place, other):
    nodes = [NODES[index] for index in order]
    if place == other:
        return
    missing, nodes[place] = nodes[place], nodes[other]
    with pytest.raises(PacketError) as caught:
        resolve_nodes(nodes)
    assert f"missing [{missing}]" in caught.value.message
    assert f"named twice [{nodes[other]}]" in caught.value.message
    with pytest.raises(PacketError, match="named twice"):
        parse_node_order(node_bytes(nodes))


@pytest.mark.parametrize("node", [("thumb", "intermediate"), ("tail", "tip")])
def test_an_unknown_node_is_refused_and_named(node):
    with pytest.raises(PacketError, match=f"unknown .*{node[0]}.*{node[1]}"):
        resolve_nodes([*NODES[:-1], node])


def test_more_nodes_than_25_are_refused():
    with pytest.raises(PacketError, match="named twice"):
        resolve_nodes([*NODES, NODES[3]])
    with pytest.raises(PacketError, match="unknown"):
        parse_node_order(node_bytes(NODES) + bytes([9, 9]))


def test_half_a_node_is_refused():
    with pytest.raises(PacketError, match="missing"):
        parse_node_order(node_bytes(NODES)[:-1])


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_node_that_is_no_place_is_not_seen(number):
    points = points_of()
    points[NODE_INDEX["index", "tip"], 1] = number
    payload = VALIDITY.pack(ALL_SEEN) + points.tobytes()
    keypoints, num_unseen = unpack_keypoints(payload, np.arange(NUM_KEYPOINTS))
    assert num_unseen == 1
    assert np.isnan(keypoints[NODE_INDEX["index", "tip"]]).all()
    assert np.isfinite(np.delete(keypoints, NODE_INDEX["index", "tip"], axis=0)).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_shuffled_device_over_hid(seed):
    packets, values = source(seed)
    port = HidPort("mock", answer=packets.answer)
    port.plug()
    driver = FingerTracker("fingers", "left", transport=port.transport, clock=VirtualClock())
    driver.open()
    samples = []
    for sequence in range(len(values)):
        for unit in packets.units(sequence, sequence, sequence):
            port.send(unit)
            samples += driver.read().get("keypoints_left", [])
    assert np.array_equal([s.values for s in samples], values.astype(np.float32))
    driver.close()


def test_a_device_that_says_nothing_of_its_nodes_is_refused(monkeypatch):
    monkeypatch.setattr("services.acquisition.devices.finger_tracker.DESCRIPTOR_READS", 2)
    port = HidPort("mock", answer=lambda report: [])
    port.plug()
    driver = FingerTracker("fingers", "left", transport=port.transport, clock=VirtualClock())
    with pytest.raises(DeviceError, match="no node descriptor"):
        driver.open()


def test_repeated_and_late_packets_become_no_sample():
    packets, _ = source()
    decoder = FingerTrackerDecoder("left")
    found = []
    for report in packets.answer(b"\x02"):
        decoder.decode(report, 0)
    for sequence in (0, 1, 1, 3, 2, 4):
        for report in packets.units(sequence, sequence, sequence):
            found += decoder.decode(report, 0).get("keypoints_left", [])
    assert [sample.sequence for sample in found] == [0, 1, 3, 4]
    assert (decoder.statistics.repeated, decoder.statistics.late) == (1, 1)
