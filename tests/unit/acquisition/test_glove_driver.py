"""Our glove over a pseudo terminal: commands, identity, swaps."""

import threading

import numpy as np
import pytest

from dextouch.errors import DeviceError, InvalidInputError, PacketError
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.devices.tactile_glove import (
    TactileGlove,
    encode_identity,
    parse_identity,
    parse_reply,
)
from services.acquisition.drivers.packets import Packet
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.gloves import (
    GloveCalibration,
    mock_glove,
    mock_justfloat_glove,
    mock_wuji_glove,
)
from services.acquisition.mocks.ports import PtyPort
from services.acquisition.mocks.replay import MockSlot, ReplayStream


def pressures(count=20):
    values = np.random.default_rng(3).uniform(0, 50, (count, 320)).astype(np.float32)
    descriptor = StreamDescriptor(
        name="tactile_left",
        kind="tactile",
        shape=(320,),
        dtype="float32",
        unit="kPa",
        nominal_rate_hz=60,
    )
    return ReplayStream(descriptor, np.arange(count, dtype=np.int64) * 16_666_667, values)


def make(side="left", **options):
    return mock_glove(
        MockSlot(f"glove_{side}", pressures(), DeviceFaults(), 1, StationClock()),
        calibration=GloveCalibration.seeded(side, 1),
        **options,
    )


@pytest.fixture
def glove():
    pair = make()
    pair.device.port.plug()
    yield pair
    pair.driver.close()
    pair.device.port.unplug()


def play(pair, indices):
    for index in indices:
        for unit in pair.device.source.units(index, index, 1000 + index):
            assert pair.device.port.send(unit)


def read_samples(driver, count):
    found = []
    while len(found) < count:
        found += driver.read().get(driver.descriptors[0].name, [])
    return found


def test_opening_asks_who_it_is(glove):
    glove.driver.open()
    identity = glove.driver.identify()
    assert (identity.serial_number, identity.firmware) == ("glove_left", "1.0.0")
    assert identity.side == "left"


def test_a_driver_that_was_started_anew_is_answered_too(glove):
    """Its requests are numbered as those of the first one were."""
    transport, host = glove.device.port.transport, StationClock()
    for _ in range(2):
        driver = TactileGlove("left", transport=transport, clock=host)
        driver.open()
        assert driver.identify().serial_number == "glove_left"
        driver.close()


def test_samples_that_come_during_a_request_are_kept(glove):
    glove.driver.open()
    play(glove, range(5))
    glove.driver.identify()
    play(glove, range(5, 8))
    assert [s.sequence for s in read_samples(glove.driver, 8)] == list(range(8))
    assert glove.driver.statistics.packets == 8
    assert glove.driver.statistics.lost == 0


def test_time_round_trip_is_on_the_devices_clock(glove):
    """The mock's clock, before any packet, is the host's: the offset is within the trip."""
    glove.driver.open()
    trip = glove.driver.time_round_trip()
    assert trip.sent_ns <= trip.remote_received_ns <= trip.remote_sent_ns <= trip.received_ns
    assert trip.delay_ns >= 0


def test_requests_that_fail_leave_nothing_behind(glove, monkeypatch):
    glove.driver.open()

    def fail(_):
        raise DeviceError("lost while writing")

    monkeypatch.setattr(glove.driver.transport, "write", fail)
    for _ in range(3):
        with pytest.raises(DeviceError, match="lost while writing"):
            glove.driver.identify()
    monkeypatch.undo()

    def late(_):
        raise TimeoutError

    # Nobody answers this one in time; its answer comes later.
    monkeypatch.setattr(glove.driver, "_await", late)
    with pytest.raises(DeviceError, match="no answer"):
        glove.driver.identify()
    monkeypatch.undo()
    play(glove, range(1))
    read_samples(glove.driver, 1)
    assert glove.driver._asked == {}


def test_one_thread_asks_while_another_one_reads(glove):
    """As in a station."""
    glove.driver.open()
    opened = threading.Event()
    done = threading.Event()

    def read():
        glove.driver.read()
        opened.set()
        while not done.is_set():
            glove.driver.read()

    reader = threading.Thread(target=read)
    reader.start()
    assert opened.wait(10)
    play(glove, range(7))
    assert [glove.driver.identify().serial_number for _ in range(3)] == ["glove_left"] * 3
    done.set()
    reader.join()
    assert glove.driver.statistics.packets == 7


def test_swapped_gloves_are_named():
    pair = make("left", worn_side="right")
    pair.device.port.plug()
    with pytest.raises(DeviceError, match=r"says it is 'right', expected 'left'.*swapped"):
        pair.driver.open()
    pair.driver.close()
    pair.device.port.unplug()


def test_two_gloves_are_told_apart_by_serial_number(glove):
    """The ports of two gloves are exchanged: each driver refuses the other's by its number."""
    driver = TactileGlove(
        "left", transport=glove.device.port.transport, clock=StationClock(), serial_number="G-77"
    )
    with pytest.raises(DeviceError, match=r"'glove_left' at /dev/pts/\d+ is not 'G-77'"):
        driver.open()
    driver.close()


def test_a_silent_device_is_an_error():
    port = PtyPort("mute")
    port.plug()
    driver = TactileGlove("left", transport=port.transport, clock=StationClock())
    with pytest.raises(DeviceError, match="no answer to identify"):
        driver.open()
    driver.close()
    port.unplug()


def test_commands_with_bit_errors_are_asked_again(glove, monkeypatch):
    """The first request is spoilt on its way; the second is answered."""
    transport = glove.driver.transport
    write = transport.write
    sent = []

    def spoil(data):
        sent.append(data)
        write(data if len(sent) > 1 else data[:-1] + bytes([data[-1] ^ 1]))

    monkeypatch.setattr(transport, "write", spoil)
    glove.driver.open()
    assert len(sent) == 2


@pytest.mark.parametrize("make_glove", [mock_wuji_glove, mock_justfloat_glove])
def test_vendor_gloves_speak_over_a_terminal(make_glove):
    pair = make_glove(MockSlot("glove_left", pressures(), DeviceFaults(), 1, StationClock()))
    pair.device.port.plug()
    pair.driver.open()
    for index in range(6):
        (unit,) = pair.device.source.units(index, index, index * 8_000_000)
        assert pair.device.port.send(unit)
    # Without a mark at the start of a packet the first one cannot be told.
    first = 0 if make_glove is mock_wuji_glove else 1
    samples = read_samples(pair.driver, 6 - first)
    assert pair.driver.statistics.packets == 6 - first
    assert pair.driver.statistics.suspects == 0
    if first == 0:
        assert [s.sequence for s in samples] == list(range(6))
        assert [s.t_device_ns for s in samples] == [index * 8_000_000 for index in range(6)]
        assert np.isnan(samples[0].values).sum() == 768 - 320
    pair.driver.close()
    pair.device.port.unplug()


def test_replies_that_are_none_are_refused():
    with pytest.raises(PacketError, match="status 9"):
        parse_reply(Packet(1, 1, 0, 0, bytes([1, 9, 0, 0])))
    with pytest.raises(PacketError, match="20"):
        parse_identity(b"", 1)
    with pytest.raises(PacketError, match="ASCII"):
        parse_identity(b"\xff" * 20, 1)
    with pytest.raises(InvalidInputError, match="16 letters"):
        encode_identity("x" * 17, (1, 0, 0))
