"""A load process: many stations send full-rate takes at real time; a JSON report of acks comes out.

`python store_load.py --url URL --stations 8 --seconds 300 --take_s 10 --report PATH`
"""

import argparse
import json
import threading
import time
from pathlib import Path

import numpy as np

from dextouch.clients import EpisodeStoreClient
from dextouch.errors import LimitExceededError, StorageFullError, UnavailableError
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values
from services.acquisition.uploader import batch_samples

NUM_IMAGES = 16
# (names, kind, shape, dtype, unit, rate): what one station speaks.
SPOKEN = [
    (("glove_left", "glove_right"), "tactile", (360,), "uint16", "counts", 60),
    (("keypoints_left", "keypoints_right"), "keypoints", (25, 3), "float64", "m", 120),
    (("wrist_left", "wrist_right", "head"), "pose", (7,), "float64", "pose_m_wxyz", 100),
    (("joints_measured", "joints_commanded"), "robot_state", (40,), "float64", "rad", 100),
    (
        ("camera_head", "camera_wrist_left", "camera_wrist_right"),
        "image",
        (480, 640, 3),
        "uint8",
        "jpeg",
        30,
    ),
]


def streams():
    """Descriptors of all streams of a station."""
    return tuple(
        StreamDescriptor(
            name=name, kind=kind, shape=shape, dtype=dtype, unit=unit, nominal_rate_hz=rate
        )
        for names, kind, shape, dtype, unit, rate in SPOKEN
        for name in names
    )


def images():
    """JPEG images of about 50 kB, the same in every process."""
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[0:480, 0:640]
    made = []
    for shift in range(NUM_IMAGES):
        waves = np.sin(rows / 9 + shift) + np.cos(columns / 13 - shift)
        picture = 128 + 40 * waves[..., None] * np.array([1.0, 0.7, 0.4])
        picture = picture + rng.normal(0, 2.0, picture.shape)
        made.append(encode_jpeg(picture.clip(0, 255).astype(np.uint8), quality=88))
    return made


def batch_of(descriptor, first, count, pictures):
    """Samples first … first + count - 1; each value tells which sample it is."""
    k = np.arange(first, first + count, dtype=np.int64)
    t_host_ns = np.round(k * 1e9 / descriptor.nominal_rate_hz).astype(np.int64)
    if descriptor.unit == "jpeg":
        values = encoded_values([pictures[i % NUM_IMAGES] for i in k.tolist()])
    else:
        flat = np.ones((count, int(np.prod(descriptor.shape))), dtype=descriptor.dtype)
        flat *= (k % 60_000).astype(descriptor.dtype)[:, None]
        values = flat.reshape(count, *descriptor.shape)
    return SampleBatch(t_host_ns, t_host_ns + 5, k, values)


class Station(threading.Thread):
    """Sends one take after the other; every batch when its last sample would have been taken."""

    def __init__(self, index, url, options, pictures):
        super().__init__(name=f"station-{index}", daemon=True)
        self.client = EpisodeStoreClient(url, timeout_s=60)
        self.index, self.options, self.pictures = index, options, pictures
        self.wait = threading.Event().wait
        self.acks, self.finishes, self.takes, self.refused = [], [], {}, 0
        self.error = None

    def run(self):
        begin = time.monotonic() + self.index * self.options.take_s / self.options.stations
        end = time.monotonic() + self.options.seconds
        number = 0
        try:
            while (start := max(time.monotonic(), begin)) < end:
                self.take(f"load-{self.index}-{number}", start)
                number += 1
        except Exception as error:  # noqa: BLE001 - told in the report, where the test sees it
            self.error = f"{type(error).__name__}: {error}"

    def take(self, recording_id, start):
        speed, seconds = self.options.speed, self.options.take_s * self.options.speed
        attributes = RecordingAttributes(
            recording_id=recording_id,
            task="stand_bottle",
            instruction="stand it up",
            domain="robot",
            station=f"station-{self.index}",
            streams=streams(),
        )
        self.patiently(self.client.create, attributes)
        due, counts = [], {}
        for descriptor in attributes.streams:
            total, size = round(seconds * descriptor.nominal_rate_hz), batch_samples(descriptor)
            counts[descriptor.name] = -(-total // size)
            for number in range(counts[descriptor.name]):
                stop = min(total, (number + 1) * size)
                at = stop / descriptor.nominal_rate_hz / speed
                due.append((at, descriptor.name, number, number * size, stop, descriptor))
        for at, name, number, first, stop, descriptor in sorted(due, key=lambda row: row[:3]):
            batch = batch_of(descriptor, first, stop - first, self.pictures)
            self.wait(max(0.0, start + at - time.monotonic()))
            sent = time.monotonic()
            self.patiently(self.client.send_batch, recording_id, descriptor, batch, number=number)
            done = time.monotonic()
            self.acks.append((sent, done - sent, sent - start - at, name))
        began = time.monotonic()
        self.patiently(self.client.finish, recording_id, counts)
        self.finishes.append((began, time.monotonic()))
        self.takes[recording_id] = {
            d.name: round(seconds * d.nominal_rate_hz) for d in attributes.streams
        }

    def patiently(self, call, *arguments, **more):
        """Again after every refusal that says when."""
        while True:
            try:
                return call(*arguments, **more)
            except (LimitExceededError, UnavailableError, StorageFullError) as error:
                if "retry_after_s" not in error.details:
                    raise
                self.refused += 1
                self.wait(error.details["retry_after_s"])


def percentiles(values):
    """Median, 99th percentile and the worst, in milliseconds."""
    if not len(values):
        return {"num": 0}
    low, high, worst = np.percentile(np.array(values) * 1e3, [50, 99, 100])
    return {"num": len(values), "p50": low, "p99": high, "worst": worst}


def report_of(stations):
    """What the stations saw, in milliseconds; `in_finish` while another take was being finished."""
    acks = [(index, *ack) for index, s in enumerate(stations) for ack in s.acks]
    finishes = [(index, *span) for index, s in enumerate(stations) for span in s.finishes]
    beside = [
        seconds
        for index, sent, seconds, _, _ in acks
        if any(
            other != index and began < sent + seconds and sent < ended
            for other, began, ended in finishes
        )
    ]
    by_stream = {}
    for _, _, seconds, _, name in acks:
        by_stream.setdefault(name.split("_")[0], []).append(seconds)
    return {
        "ack_ms": percentiles([ack[2] for ack in acks]),
        "ack_ms_in_finish": percentiles(beside),
        "ack_ms_by_kind": {name: percentiles(seconds) for name, seconds in by_stream.items()},
        "late_ms": percentiles([ack[3] for ack in acks]),
        "finish_ms": percentiles([ended - began for _, began, ended in finishes]),
        "num_refused": sum(s.refused for s in stations),
        "takes": {name: counts for s in stations for name, counts in s.takes.items()},
        "errors": [s.error for s in stations if s.error],
    }


def main():
    """Run the load and write the report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--url", required=True)
    parser.add_argument("--report", type=Path, required=True)
    parser.add_argument("--stations", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--take_s", type=float, default=10)
    parser.add_argument("--speed", type=float, default=1)
    options = parser.parse_args()
    pictures = images()
    stations = [Station(i, options.url, options, pictures) for i in range(options.stations)]
    started = time.process_time()
    for station in stations:
        station.start()
    for station in stations:
        station.join()
        station.client.close()
    report = report_of(stations)
    report["image_bytes"] = sum(map(len, pictures)) / len(pictures)
    report["cpu_s"] = time.process_time() - started
    options.report.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
