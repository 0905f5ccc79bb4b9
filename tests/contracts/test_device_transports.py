"""Every transport behaves alike, on a mock port that stands for the device."""

import pytest

from dextouch.errors import DeviceError
from services.acquisition.mocks.ports import HidPort, PtyPort, SocketPort

PORTS = {"serial": PtyPort, "hid": HidPort, "socket": SocketPort}
UNIT = bytes(range(64))


@pytest.fixture(params=PORTS)
def port(request):
    port = PORTS[request.param]("mock")
    port.plug()
    yield port
    port.transport.close()
    port.unplug()


def read_until(transport, size):
    data = b""
    while len(data) < size:
        data += transport.read()
    return data


def test_reads_what_the_device_sends(port):
    port.transport.open()
    assert port.transport.read() == b""
    for _ in range(3):
        assert port.send(UNIT)
    assert read_until(port.transport, 3 * len(UNIT)) == 3 * UNIT


def test_says_where_it_leads(port):
    port.transport.open()
    assert str(port.transport.info).split()[0] in PORTS


def test_closed_transport_refuses(port):
    with pytest.raises(DeviceError, match="not open"):
        port.transport.read()
    with pytest.raises(DeviceError, match="not open"):
        port.transport.write(b"1")


def test_absent_device_is_an_error(port):
    port.unplug()
    with pytest.raises(DeviceError):
        port.transport.open()


def test_unplugging_is_an_error_and_replugging_mends_it(port):
    port.transport.open()
    port.unplug()
    with pytest.raises(DeviceError):
        port.transport.read()
    port.transport.close()
    port.plug()
    port.transport.open()
    assert port.send(UNIT)
    assert read_until(port.transport, len(UNIT)) == UNIT


def test_closing_twice_is_fine(port):
    port.transport.open()
    port.transport.close()
    port.transport.close()
    assert not port.link.is_open


def test_link_knows_what_was_processed(port):
    port.transport.open()
    port.send(UNIT)
    read_until(port.transport, len(UNIT))
    # What the last read gave is processed only when the host asks for more.
    assert 0 < port.link._ahead <= len(UNIT)
    port.transport.read()
    assert port.link._ahead == 0
    port.link.wait_consumed()


def test_serial_port_is_exclusive():
    first = PtyPort("mock")
    first.plug()
    second = PtyPort("mock")
    second._master, second._slave = first._master, first._slave
    first.transport.open()
    with pytest.raises(DeviceError, match="in use"):
        second.transport.open()
    first.transport.close()
    first.unplug()


def test_hid_ring_drops_the_newest():
    port = HidPort("mock")
    port.plug()
    port.transport.open()
    taken = [port.send(bytes([number]) * 64) for number in range(80)]
    assert taken == [True] * HidPort.max_reports + [False] * (80 - HidPort.max_reports)
    assert [port.transport.read()[0] for _ in range(63)] == list(range(63))
    assert port.transport.read() == b""


def test_hid_write_counts_one_more():
    port = HidPort("mock", answer=lambda report: [report])
    port.plug()
    assert port.write(UNIT) == 65
    port.transport.open()
    port.transport.write(UNIT)
    assert port.transport.read() == UNIT
