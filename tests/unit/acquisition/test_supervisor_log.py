"""What a device that is not there writes into the log of a station."""

from structlog.testing import capture_logs

from dextouch.errors import DeviceError, PacketError
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.devices.pose_tracker import PoseTrackerDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.mocks.ports import HidPort
from services.acquisition.supervisor import DeviceSupervisor


class Waits(StationClock, Waiter):
    """A clock that jumps to the end of every wait; after the last one the station stops."""

    def __init__(self, num_waits):
        self.t_ns, self.num_left, self.supervisor = 10**12, num_waits, None

    def now_ns(self):
        return self.t_ns

    def waiter(self, *, drives_time=False):
        return self

    def wait_until(self, t_ns):
        self.t_ns, self.num_left = t_ns, self.num_left - 1
        if self.num_left == 0:
            self.supervisor._stopping.set()
        return True

    def suspended_ns(self):
        return 0

    def wall_offset_ns(self):
        return 0

    def cancel(self):
        pass

    def close(self):
        pass


class Broken(Driver):
    """A device whose driver has a mistake, or whose firmware says what there is not."""

    num_opened = 0

    def open(self):
        self.num_opened += 1
        raise (PacketError if self.num_opened > 600 else RuntimeError)("head: impossible")


class Absent(Driver):
    """A device that says in turn why it is not there."""

    messages = ("head: no such device",)
    num_opened = 0

    def open(self):
        self.num_opened += 1
        raise DeviceError(self.messages[self.num_opened * len(self.messages) // 1000])


def lines(num_waits, kind=Absent, messages=Absent.messages):
    clock = Waits(num_waits)
    driver = kind(
        "head",
        transport=HidPort("head").transport,
        decoder=PoseTrackerDecoder("head"),
        clock=clock,
    )
    driver.messages = messages
    clock.supervisor = DeviceSupervisor(driver, sink=lambda *_: None, clock=clock)
    with capture_logs() as logs:
        clock.supervisor._run()
    assert driver.num_opened == num_waits
    return logs


def losses(num_waits, messages=Absent.messages):
    logs = lines(num_waits, messages=messages)
    return [(e["error"], e["count"]) for e in logs if e["event"] == "lose_device"]


def test_an_absent_device_is_logged_once_and_then_once_a_minute():
    # 900 tries, 0.2 s apart, are three minutes.
    message = "head: no such device"
    assert losses(900) == [(message, 1), (message, 301), (message, 601)]


def test_another_reason_is_logged_at_once():
    assert losses(900, ("gone", "no permission")) == [
        ("gone", 1),
        ("gone", 301),
        ("no permission", 1),
        ("no permission", 301),
    ]


def test_a_driver_that_fails_is_logged_as_rarely():
    logs = lines(900, kind=Broken)
    # Two minutes of a mistake, with its traceback, and one of what the device says.
    told = [("fail_device", "error", 1), ("fail_device", "error", 301)]
    assert [(e["event"], e["log_level"], e["count"]) for e in logs] == [
        *told,
        ("lose_device", "warning", 1),
    ]


class Quiet(Driver):
    """A device whose decoder names its stream in every second read without a sample of it."""

    num_reads = 0

    def open(self):
        pass

    def read(self):
        self.num_reads += 1
        if self.num_reads == 6:
            self.stop.set()
        return {"head": [object()]} if self.num_reads % 2 else {"head": []}


def test_a_stream_without_a_sample_is_no_reading():
    seen = []
    decoder = PoseTrackerDecoder("head")
    driver = Quiet("head", transport=HidPort("head").transport, decoder=decoder, clock=Waits(9))
    supervisor = DeviceSupervisor(driver, sink=seen.append, clock=Waits(9))
    driver.stop = supervisor._stopping
    supervisor.count = seen.append
    supervisor._run()
    assert len(seen) == 2 * 3
    assert all(samples for readings in seen for samples in readings.values())
    assert supervisor.last_error is None
