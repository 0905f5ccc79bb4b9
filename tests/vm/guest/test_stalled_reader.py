"""A reader that stalls while a finger tracker sends: the kernel's ring fills, the rest is lost."""

import os
import signal
from itertools import chain
from unittest.mock import Mock

import numpy as np
import pytest

from services.acquisition.devices.finger_tracker import FingerTrackerSettings
from tests.vm.guest import kernel_devices, packets
from tests.vm.guest.conftest import collect

IDS = (0x1209, 0x0D03)
SERIAL = "FINGERS-L"
STREAM = "keypoints_left"
# hidraw's ring of unread reports (HIDRAW_BUFFER_SIZE in the kernel is 64, one place stays free).
RING = 63
# The report that carries a message's number counts them in a byte.
MESSAGE_COUNTER = 256
SETTINGS = FingerTrackerSettings(
    side="left", vendor_id=IDS[0], product_id=IDS[1], serial_number=SERIAL
)


@pytest.fixture
def tracker():
    device = kernel_devices.UserHid(ids=IDS, serial_number=SERIAL, answer=packets.answer_with_nodes)
    yield device
    device.destroy()


def assert_keypoints(samples, numbers):
    assert [sample.sequence for sample in samples] == list(numbers)
    for sample in samples:
        assert sample.t_device_ns == sample.sequence * packets.PERIOD_NS
        np.testing.assert_array_equal(sample.values, packets.keypoints(sample.sequence))


def fill_the_ring(tracker, driver, messages):
    """Send all while nobody reads, then read what the kernel kept: its number of whole messages."""
    feed = driver.decoder.reports.feed = Mock(wraps=driver.decoder.reports.feed)
    # The process that reads stalls; that of the station may do so without a loss.
    os.kill(driver.transport.reader_pid, signal.SIGSTOP)
    for report in chain(*messages):
        tracker.send(report)
    os.kill(driver.transport.reader_pid, signal.SIGCONT)
    num_kept = RING // len(messages[0])
    assert_keypoints(collect(driver, STREAM, num_kept), range(num_kept))
    # What is left is the begin of a message, and then nothing.
    while feed.call_count < RING:
        assert driver.read() == {}
    assert driver.read() == {}
    assert feed.call_count == RING
    return num_kept


@pytest.mark.parametrize("num_sent", [11, 40, 300])
def test_what_the_ring_cannot_hold_is_counted(tracker, opened, measured, num_sent):
    driver = opened(SETTINGS)
    messages = packets.keypoint_reports(0, num_sent + 1)
    num_kept = fill_the_ring(tracker, driver, messages[:num_sent])
    for report in messages[num_sent]:
        tracker.send(report)
    assert_keypoints(collect(driver, STREAM, 1), [num_sent])
    assert driver.statistics.lost == num_sent - num_kept
    # Half of a message was kept.
    assert driver.decoder.reports.num_incomplete == 1
    measured(
        "finger tracker, uhid",
        f"{num_sent} packets unread",
        f"{num_kept} kept whole, {driver.statistics.lost} counted lost, 0 wrong",
    )


def test_halves_of_two_messages_with_one_number_make_no_sample(tracker, opened, measured):
    driver = opened(SETTINGS)
    messages = packets.keypoint_reports(0, MESSAGE_COUNTER + 20)
    num_kept = fill_the_ring(tracker, driver, messages[:MESSAGE_COUNTER])
    # The ring ends within message `num_kept`; the next with the same number goes on from there.
    num_parts = RING % len(messages[0])
    twin = MESSAGE_COUNTER + num_kept
    assert 0 < num_parts < len(messages[0])
    for report in (*messages[twin][num_parts:], *messages[twin + 1]):
        tracker.send(report)
    assert_keypoints(collect(driver, STREAM, 1), [twin + 1])
    assert driver.statistics.crc_errors == 1
    assert driver.statistics.lost == twin + 1 - num_kept
    measured(
        "finger tracker, uhid",
        "halves of two messages joined",
        f"refused by checksum, {driver.statistics.lost} counted lost, 0 wrong",
    )
