"""Bridge to the Lab Streaming Layer: the numbers of one outlet.

Stamps of an outlet are seconds of `local_clock()` of the computer that made them. liblsl measures
by round trips what has to be added for this computer's `local_clock()`, which is CLOCK_MONOTONIC on
Linux (`std::chrono::steady_clock`), and how uncertain that is.
"""

import ctypes
import struct
import time
from collections.abc import Sequence
from math import isfinite
from typing import Any

from dextouch.errors import DeviceError, InvalidInputError
from services.acquisition.clock import station_offset_ns
from services.acquisition.drivers.packets import SOURCES
from services.acquisition.drivers.sdk_link import MAX_CHANNELS, BridgeHello
from services.acquisition.sdk_bridges import bridge

INSTALL = "`pip install pylsl`"
# Chosen: outlets of the same network answer within half a second, and the bridge tries again.
RESOLVE_S = 1.0
CORRECTION_S = 3.0
READ_S = 0.02
# Chosen: half a queue of the server, so that one chunk never fills it.
MAX_SAMPLES = 256
# liblsl measures its offset every few seconds.
CORRECTION_PERIOD_S = 1.0


class LslStream(bridge.Source):
    """One outlet of the Lab Streaming Layer with numeric channels.

    Its property `by` (`name`, `type` or `source_id`) has the value.
    """

    clock = (
        "the outlet's local_clock(), converted by liblsl's time_correction() to this host's "
        "CLOCK_MONOTONIC and from there to its raw monotonic clock"
    )

    def __init__(self, value: str, *, by: str = "name") -> None:
        super().__init__()
        self._value, self._by = value, by
        self._inlet: Any = None
        self._correction_s = self._uncertainty_s = self._corrected_s = 0.0

    def open(self) -> BridgeHello:
        """Find the outlet, connect to it, and measure the offset of its clock.

        Raises:
            InvalidInputError: several outlets, or one without numbers.
        """
        lsl = bridge.import_sdk("pylsl", install=INSTALL)
        found = lsl.resolve_byprop(self._by, self._value, minimum=2, timeout=RESOLVE_S)
        if not found:
            raise DeviceError(
                f"LSL: no outlet whose {self._by} is {self._value!r}; list those there are with "
                "--list"
            )
        if len(found) > 1:
            raise InvalidInputError(
                f"LSL: {len(found)} outlets have the {self._by} {self._value!r}, expected one; "
                "choose by source_id (--by source_id): "
                + ", ".join(info.source_id() for info in found)
            )
        info = found[0]
        num_channels = info.channel_count()
        if info.channel_format() == lsl.cf_string or not 1 <= num_channels <= MAX_CHANNELS:
            raise InvalidInputError(
                f"LSL: outlet {info.name()!r} has {num_channels} channels of the format "
                f"{info.channel_format()}, expected 1 … {MAX_CHANNELS} of numbers; markers in "
                "words are not sent"
            )
        # Not recovered by liblsl: an outlet that comes back may have other channels.
        self._inlet = lsl.StreamInlet(info, recover=False, max_buflen=1)
        self._guarded(lambda: self._inlet.open_stream(CORRECTION_S))
        self._correct(CORRECTION_S)
        return bridge.hello(
            kind="numbers",
            software=f"liblsl {lsl.library_version()}, outlet {info.name()} at {info.hostname()}",
            devices=({"index": 0, "serial_number": self._value, "source": "none"},),
            frame=bridge.OUR_AXES,
            channels=num_channels,
        )

    def read(self) -> Sequence[bridge.Reading]:
        """New samples."""
        if time.monotonic() - self._corrected_s > CORRECTION_PERIOD_S:
            self._correct(0.0)
        samples, stamps = self._guarded(
            lambda: self._inlet.pull_chunk(timeout=READ_S, max_samples=MAX_SAMPLES, min_samples=1)
        )
        offset_ns = station_offset_ns(self._clock)
        readings = []
        for values, stamp_s in zip(samples, stamps, strict=True):
            corrected_s = stamp_s + self._correction_s
            # One without a time is not sent, as one from before the clock's start.
            t_ns = round(corrected_s * 1e9) + offset_ns if isfinite(corrected_s) else -1
            payload = struct.pack(f"<{len(values)}d", *values)
            readings.append(bridge.Reading(self._value, SOURCES["none"], t_ns, payload))
        return readings

    def close(self) -> None:
        """Disconnect."""
        if self._inlet is not None:
            self._inlet.close_stream()
        self._inlet = None

    def present(self) -> list[str]:
        """Name, type, source_id and shape of every outlet of the network."""
        lsl = bridge.import_sdk("pylsl", install=INSTALL)
        return [
            f"{info.name()} (type {info.type()}, source_id {info.source_id()}, "
            f"{info.channel_count()} channels, {info.nominal_srate():g} Hz, {info.hostname()})"
            for info in lsl.resolve_streams(RESOLVE_S)
        ]

    def report(self) -> list[str]:
        """The last offset of the clocks."""
        return [
            f"offset of the outlet's clock: {self._correction_s:.6f} s, uncertain by "
            f"{self._uncertainty_s * 1e3:.2f} ms at most"
        ]

    def _guarded(self, call: Any) -> Any:  # noqa: ANN401 - as pylsl's
        """What a call of pylsl gives; DeviceError of an outlet that is lost or does not answer."""
        try:
            return call()
        except RuntimeError as error:  # LostError, TimeoutError and others of pylsl
            raise DeviceError(
                f"LSL: outlet {self._value!r} is lost ({type(error).__name__} {error})"
            ) from error

    def _correct(self, timeout_s: float) -> None:
        """Ask liblsl for the present offset; the last one stays where it has no newer one."""
        self._corrected_s = time.monotonic()
        lib = bridge.import_sdk("pylsl.lib", install=INSTALL).lib
        function = lib.lsl_time_correction_ex
        function.restype = ctypes.c_double
        remote_s, uncertainty_s, code = ctypes.c_double(), ctypes.c_double(), ctypes.c_int32()
        correction_s = function(
            self._inlet.obj,
            ctypes.byref(remote_s),
            ctypes.byref(uncertainty_s),
            ctypes.c_double(timeout_s),
            ctypes.byref(code),
        )
        if code.value == 0:
            self._correction_s, self._uncertainty_s = correction_s, uncertainty_s.value
        elif timeout_s:
            raise DeviceError(
                f"LSL: outlet {self._value!r} does not answer for its clock (error {code.value}); "
                "is UDP between the two computers allowed?"
            )
