"""What waits between the readers and the health thread."""

import threading

import numpy as np
import pytest

from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.health.streams import SampleQueue

POSE = StreamDescriptor(
    name="head", kind="pose", shape=(7,), dtype="float64", unit="pose_m_wxyz", nominal_rate_hz=10
)
# Four seconds.
SIZE = 40


def sample(index):
    return Sample(index, np.full(7, float(index)), 2 * index, 3 * index)


def test_what_is_taken_is_what_came_since_in_whatever_portions(rng):
    queue, waiting, latencies, dropped, index, now_ns = SampleQueue(POSE), [], [], 0, 0, 0
    for _ in range(500):
        for _ in range(int(rng.integers(0, 12))):
            samples = [sample(index + k) for k in range(int(rng.integers(1, 8)))]
            index += len(samples)
            now_ns += 1
            queue.add(samples, now_ns)
            waiting += samples
            latencies += [now_ns - s.t_host_ns for s in samples]
        dropped += max(0, len(waiting) - SIZE)
        waiting = waiting[-SIZE:]
        block = queue.take()
        assert block.t_host_ns.tolist() == [s.t_host_ns for s in waiting]
        assert block.t_device_ns.tolist() == [s.t_device_ns for s in waiting]
        assert block.sequence.tolist() == [s.sequence for s in waiting]
        assert block.latency_ns.tolist() == latencies[-SIZE:]
        if waiting:
            np.testing.assert_array_equal(block.values, [s.values for s in waiting])
        else:
            assert block.values is None
        waiting, latencies = [], []
        assert queue.num_dropped == dropped
    assert dropped > 100


def test_what_was_taken_does_not_change_when_more_comes():
    queue = SampleQueue(POSE)
    queue.add([sample(index) for index in range(SIZE)], 0)
    block = queue.take()
    queue.add([sample(1000 + index) for index in range(SIZE)], 0)
    assert block.t_host_ns.tolist() == list(range(SIZE))
    assert block.values[:, 0].tolist() == list(range(SIZE))


@pytest.mark.long
def test_nothing_is_lost_or_mixed_between_two_threads():
    queue, seen, count = SampleQueue(POSE), [], 20_000
    done = threading.Event()

    def read():
        for index in range(count):
            queue.add([sample(index)], 0)
        done.set()

    reader = threading.Thread(target=read)
    reader.start()
    while not done.is_set() or not seen or seen[-1] < count - 1:
        block = queue.take()
        if len(block):
            np.testing.assert_array_equal(block.values[:, 0], block.t_host_ns)
            np.testing.assert_array_equal(block.sequence, 3 * block.t_host_ns)
        seen += block.t_host_ns.tolist()
    reader.join()
    assert len(seen) + queue.num_dropped == count
    assert np.all(np.diff(seen) > 0)
