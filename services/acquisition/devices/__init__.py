"""Device kinds of a station, and everything that a lab's own kind of device is written with.

Other packages can provide further devices through the entry point `dextouch.devices`:
docs/tutorials/add_a_device.md builds one.
"""

from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import (
    ENTRY_POINT_GROUP,
    DeviceKind,
    DeviceSettings,
    GloveSettings,
    SerialLineSettings,
    build_drivers,
    device_kind,
    kind_names,
    load_calibration,
    serial_transport,
)
from services.acquisition.drivers.base import (
    CellLayout,
    Decoder,
    Driver,
    Readings,
    StreamDecoder,
    hand_name,
)
from services.acquisition.drivers.packets import DecoderStatistics, FrameSearch, SequenceCounter
from services.acquisition.transports import Transport, TransportInfo

__all__ = [
    "ENTRY_POINT_GROUP",
    "CellLayout",
    "ClockCapabilities",
    "Decoder",
    "DecoderStatistics",
    "DeviceKind",
    "DeviceSettings",
    "Driver",
    "FrameSearch",
    "GloveSettings",
    "Readings",
    "Sample",
    "SequenceCounter",
    "SerialLineSettings",
    "StationClock",
    "StreamDecoder",
    "StreamDescriptor",
    "Transport",
    "TransportInfo",
    "build_drivers",
    "device_kind",
    "hand_name",
    "kind_names",
    "load_calibration",
    "serial_transport",
]
