"""Driver of a finger tracker by HID, USB or its SDK's bridge: 25 keypoints of one hand, in m."""

import struct
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from jaxtyping import Float32, Int64

from dextouch.errors import DeviceError, InvalidInputError, PacketError
from dextouch.hands import CHAINS, FINGER_JOINTS, NO_KEYPOINT, NUM_KEYPOINTS, WRIST, node_order
from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import DeviceKind, TrackerSettings, tracker_transport
from services.acquisition.drivers import base, sdk_link
from services.acquisition.drivers.packets import SOURCES, Packet, PacketDecoder
from services.acquisition.transports import Transport

MAGIC = b"DXFT"
DESCRIPTOR_MAGIC = b"DXFD"
NOMINAL_RATE_HZ = 120.0
CHAIN_IDS: Final = {name: index for index, name in enumerate((WRIST, *CHAINS))}
JOINT_IDS: Final = {name: index for index, name in enumerate((WRIST, *FINGER_JOINTS))}
VALIDITY = struct.Struct("<I")
PAYLOAD_BYTES = VALIDITY.size + NUM_KEYPOINTS * 12
DESCRIPTOR_BYTES = 2 * NUM_KEYPOINTS
DESCRIPTOR_READS = 200
ALL_SEEN = (1 << NUM_KEYPOINTS) - 1
_COORDINATE = np.dtype("<f4")


def keypoints_descriptor(side: Side) -> StreamDescriptor:
    """The stream of one tracked hand; a node the device does not see is NaN."""
    return StreamDescriptor(
        name=f"keypoints_{side}",
        kind="keypoints",
        shape=(NUM_KEYPOINTS, 3),
        dtype="float32",
        unit="m",
        nominal_rate_hz=NOMINAL_RATE_HZ,
        frame=f"wrist_{side}",
        side=side,
        device=f"finger_tracker_{side}",
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


def resolve_nodes(nodes: Sequence[tuple[str, str]]) -> list[int]:
    """Our keypoint index of each (chain, joint), in the device's order, whatever that is.

    Raises:
        PacketError: a node unknown to us, missing, or named twice; the message says which.
    """
    try:
        places = list(node_order(nodes).places)
    except InvalidInputError as error:
        raise PacketError(f"descriptor: {error.message}", **error.details) from error
    if NO_KEYPOINT in places:
        raise PacketError(
            f"descriptor: expected each of the {NUM_KEYPOINTS} nodes once; unknown "
            f"{[nodes[place] for place, index in enumerate(places) if index == NO_KEYPOINT]}: a "
            "palm is no keypoint, leave it out"
        )
    return places


def parse_node_order(payload: bytes) -> list[int]:
    """Our keypoint index of each node of a `DXFD` payload, in the device's order.

    Raises:
        PacketError: a node unknown to us, or not each of the 25 exactly once.
    """
    chains = {number: name for name, number in CHAIN_IDS.items()}
    joints = {number: name for name, number in JOINT_IDS.items()}
    return resolve_nodes(
        [
            (chains.get(chain, f"chain {chain}"), joints.get(joint, f"joint {joint}"))
            for chain, joint in zip(payload[::2], payload[1::2], strict=False)
        ]
    )


def unpack_keypoints(
    payload: bytes, order: Int64[np.ndarray, "25"]
) -> tuple[Float32[np.ndarray, "25 3"], int]:
    """Keypoints of a `DXFT` payload in our order, and how many nodes are not seen (NaN).

    A node that the device calls seen but sends as NaN or infinity is not seen either.
    """
    (valid_bits,) = VALIDITY.unpack_from(payload)
    points = np.frombuffer(payload, _COORDINATE, offset=VALIDITY.size).reshape(-1, 3)
    keypoints = np.empty((NUM_KEYPOINTS, 3), dtype=np.float32)
    keypoints[order] = points
    is_seen = valid_bits & ALL_SEEN == ALL_SEEN
    if is_seen and np.count_nonzero(np.isfinite(points)) == points.size:
        return keypoints, 0
    if not is_seen:
        keypoints[[order[i] for i in range(NUM_KEYPOINTS) if not valid_bits >> i & 1]] = np.nan
    unseen = ~np.isfinite(keypoints).all(axis=1)
    keypoints[unseen] = np.nan
    return keypoints, int(unseen.sum())


class FingerTrackerDecoder(base.ReportDecoder):
    """Joins reports, resolves nodes by the descriptor's ids, marks unseen nodes with NaN.

    Its `statistics` are those of the data packets.
    """

    def __init__(self, side: Side) -> None:
        packets = PacketDecoder(MAGIC, min_payload=PAYLOAD_BYTES, max_payload=PAYLOAD_BYTES)
        super().__init__(keypoints_descriptor(side), packets)
        self._side = side
        self._device = f"finger_tracker_{side}"
        self._descriptor = PacketDecoder(
            DESCRIPTOR_MAGIC, min_payload=DESCRIPTOR_BYTES, max_payload=DESCRIPTOR_BYTES
        )
        self._order: Int64[np.ndarray, 25] | None = None
        self.unseen_nodes = 0

    @property
    def described(self) -> bool:
        """Whether the node order is known."""
        return self._order is not None

    def events(self) -> dict[str, int]:
        """Nodes that were not seen so far."""
        return {"unseen_nodes": self.unseen_nodes}

    def reset(self) -> None:
        """Forget half a message and the node order (another device may answer now)."""
        super().reset()
        self._descriptor.reset()
        self._order = None

    def _is_data(self, report_id: int, body: bytes) -> bool:
        if report_id != base.DESCRIPTOR_REPORT:
            return True
        for packet in self._descriptor.feed(body):
            base.check_packet(packet, device=self._device, source=self._side)
            try:
                self._order = np.array(parse_node_order(packet.payload))
            except PacketError as error:
                raise DeviceError(f"{self._device}: {error.message}") from error
        return False

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        base.check_packet(packet, device=self._device, source=self._side)
        if self._order is None:
            return None
        keypoints, num_unseen = unpack_keypoints(packet.payload, self._order)
        self.unseen_nodes += num_unseen
        return Sample(t_host_ns, keypoints, packet.t_device_ns, packet.sequence)


class FingerTracker(base.Driver):
    """A finger tracker asks for the node descriptor before it reads."""

    def __init__(self, name: str, side: Side, *, transport: Transport, clock: StationClock) -> None:
        self._nodes = FingerTrackerDecoder(side)
        super().__init__(name, transport=transport, decoder=self._nodes, clock=clock)

    def open(self) -> None:
        """Open and learn the node order.

        Raises:
            DeviceError: absent, or it does not describe its nodes.
        """
        super().open()
        self.transport.write(bytes([base.DESCRIPTOR_REPORT]).ljust(base.REPORT_BYTES, b"\0"))
        for _ in range(DESCRIPTOR_READS):
            super().read()
            if self._nodes.described:
                return
        raise DeviceError(f"{self.name}: {self.info} sends no node descriptor; wrong firmware?")


class BridgeFingerTrackerDecoder(sdk_link.BridgeDecoder):
    """Keypoints (float32 [25, 3], m, wrist frame) of one hand behind a finger tracker's SDK.

    Without a serial number it is the bridge's only one of this side.
    """

    def __init__(self, side: Side, *, serial_number: str | None = None) -> None:
        super().__init__(
            "finger_tracker",
            keypoints_descriptor(side),
            source=side,
            serial_number=serial_number,
            magic=MAGIC,
            payload_bytes=PAYLOAD_BYTES,
        )
        self._announced: list[int] = []
        self._order: Int64[np.ndarray, 25] = np.arange(NUM_KEYPOINTS)
        self._ours_m = np.eye(3)
        self.unseen_nodes = 0

    def events(self) -> dict[str, int]:
        """Packets left out so far, by the reason, and nodes that were not seen."""
        return {**super().events(), "unseen_nodes": self.unseen_nodes}

    def _learn(self, hello: sdk_link.BridgeHello, chosen: sdk_link.BridgedDevice) -> None:
        try:
            self._order = np.array(resolve_nodes(hello.nodes or ()))
        except PacketError as error:
            raise self._error(error.message, "wrong_nodes") from error
        self._announced = [SOURCES[device.source] for device in hello.devices]
        self._ours_m = hello.scale_m() * hello.frame.ours_from_theirs()

    def _new_sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        if packet.source != SOURCES[self._source]:
            # The other hand of the same bridge is none of ours; one it did not announce is a fault.
            if packet.source not in self._announced:
                base.check_packet(packet, device=self._device, source=self._source)
            return None
        if not self.is_fresh(packet.t_device_ns, t_host_ns):
            return None
        theirs, num_unseen = unpack_keypoints(packet.payload, self._order)
        self.unseen_nodes += num_unseen
        keypoints = (theirs.astype(np.float64) @ self._ours_m.T).astype(np.float32)
        return Sample(t_host_ns, keypoints, packet.t_device_ns, packet.sequence)


class FingerTrackerSettings(TrackerSettings):
    """A finger tracker of one hand."""

    kind: Literal["finger_tracker"] = "finger_tracker"
    side: Side


def build(settings: FingerTrackerSettings, clock: StationClock) -> base.Driver:
    """The driver of one tracker, by its link."""
    name = f"finger_tracker_{settings.side}"
    transport = tracker_transport(settings)
    if settings.link == "bridge":
        decoder = BridgeFingerTrackerDecoder(settings.side, serial_number=settings.serial_number)
        return sdk_link.BridgeDriver(name, transport=transport, decoder=decoder, clock=clock)
    return FingerTracker(name, settings.side, transport=transport, clock=clock)


KIND = DeviceKind(name="finger_tracker", settings=FingerTrackerSettings, build=build)
