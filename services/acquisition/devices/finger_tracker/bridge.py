"""A finger tracker behind the bridge to its SDK: the decoder of its packets."""

import numpy as np
from jaxtyping import Int64

from dextouch.errors import DeviceError, PacketError
from dextouch.streams import Sample
from dextouch.tactile.layout import Side
from services.acquisition.devices.finger_tracker.driver import MAGIC as FINGER_MAGIC
from services.acquisition.devices.finger_tracker.driver import PAYLOAD_BYTES as FINGER_BYTES
from services.acquisition.devices.finger_tracker.driver import (
    keypoints_descriptor,
    resolve_nodes,
    unpack_keypoints,
)
from services.acquisition.drivers.base import check_packet
from services.acquisition.drivers.packets import SOURCES, Packet, PacketDecoder
from services.acquisition.drivers.sdk_link_driver import BridgeDecoder
from services.acquisition.drivers.sdk_link_protocol import BridgeConnection, BridgeHello
from services.acquisition.drivers.tracking import TrackingEvents


class BridgeFingerTrackerDecoder(BridgeDecoder):
    """Keypoints (float32 [25, 3], m, wrist frame) of one hand behind a finger tracker's SDK.

    Args:
        side: which hand.
        serial_number: of the glove; the bridge's only one of this side if None.
    """

    def __init__(self, side: Side, *, serial_number: str | None = None) -> None:
        self._side = side
        self._device = f"finger_tracker_{side}"
        connection = BridgeConnection(
            "finger_tracker",
            device=self._device,
            source=side,
            serial_number=serial_number,
            packets=PacketDecoder(FINGER_MAGIC, min_payload=0, max_payload=FINGER_BYTES),
            payload_bytes=FINGER_BYTES,
        )
        super().__init__(keypoints_descriptor(side), connection)
        self.tracking = TrackingEvents()
        self._order: Int64[np.ndarray, 25] | None = None
        self._ours_m = np.eye(3)
        self.unseen_nodes = 0

    def events(self) -> dict[str, int]:
        """Packets left out so far, by the reason, and nodes that were not seen."""
        dropped = {**self.tracking.packets, **self.connection.order.counts()}
        return {**dropped, "unseen_nodes": self.unseen_nodes}

    def reset(self) -> None:
        """The connection was lost."""
        super().reset()
        self._order = None

    def _learn(self, hello: BridgeHello) -> None:
        """The order of the nodes and the frame.

        Raises:
            DeviceError: nodes we do not know.
        """
        try:
            self._order = np.array(resolve_nodes(hello.nodes or ()))
        except PacketError as error:
            raise DeviceError(
                f"{self._device}: {error.message}", device=self._device, event="wrong_nodes"
            ) from error
        self._ours_m = hello.scale_m() * hello.frame.ours_from_theirs()

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        hello, order = self.connection.hello, self._order
        if hello is None or order is None:
            return None
        if packet.source != SOURCES[self._side]:
            # The other hand of the same bridge is none of ours; one it did not announce is a fault.
            announced = [SOURCES[device.source] for device in hello.devices]
            if packet.source not in announced:
                check_packet(packet, device=self._device, source=self._side)
            return None
        if not self.freshness.admits(packet.t_device_ns, t_host_ns):
            self.tracking.leave_out("stale")
            return None
        theirs, num_unseen = unpack_keypoints(packet.payload, order)
        self.unseen_nodes += num_unseen
        keypoints = (theirs.astype(np.float64) @ self._ours_m.T).astype(np.float32)
        return Sample(t_host_ns, keypoints, packet.t_device_ns, packet.sequence)
