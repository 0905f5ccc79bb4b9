"""One process of a busy store: it records take after take, or it reads what others recorded.

The recorder says in a file that all have mapped where it stands; readers say in the end, as JSON,
what they compared.
"""

import json
import random
import sys
import time

import numpy as np

from dextouch.episodes import EpisodeStore
from dextouch.errors import NotFoundError, StorageError
from dextouch.hands.actions import (
    ACTION_DIM,
    IDENTITY_POSE_9D,
    JOINTS_LEFT,
    JOINTS_RIGHT,
    POSE_SLICES,
    AnchorPoses,
)
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor
from tests.system import take_source
from tests.system.take_source import STREAM_NAMES

TAKE_SECONDS, NUM_KEPT = 1.6, 3
NUM_STEPS, CAMERA = 24, "camera_head"
JOINTS = slice(JOINTS_LEFT.start, JOINTS_RIGHT.stop)


class Board:
    """Where the recorder stands: which takes still exist, and whether it has ended."""

    FIELDS = ("first_kept", "stop")

    def __init__(self, path, *, create=False):
        if create:
            np.zeros(len(self.FIELDS), np.int64).tofile(path)
        self._table = np.memmap(path, dtype=np.int64, mode="r+", shape=(len(self.FIELDS),))

    def get(self, field):
        return int(self._table[self.FIELDS.index(field)])

    def set(self, **fields):
        for field, number in fields.items():
            self._table[self.FIELDS.index(field)] = number


def take_id(number):
    return f"take-{number}"


def record(store, board, images, seconds):
    """Takes at their own pace, each then also as an episode; old ones are deleted.

    Two at least, however slow the machine: readers are to see one end and another begin.
    """
    stop_s = time.monotonic() + seconds
    number = 0
    while time.monotonic() < stop_s or number < 2:
        record_take(store, images, number)
        write_episode(store, number, images)
        if number >= NUM_KEPT:
            old = number - NUM_KEPT
            board.set(first_kept=old + 1)
            store.delete(take_id(old), kind="recording")
            store.delete(take_id(old))
        number += 1
    board.set(stop=1)
    return {"takes": number}


def record_take(store, images, number):
    attributes = take_source.attributes(take_id(number))
    with store.writer(kind="recording", attributes=attributes) as writer:
        start_s = time.monotonic()
        for due_s, name, k in take_source.schedule(TAKE_SECONDS):
            time.sleep(max(0.0, start_s + due_s - time.monotonic()))
            writer.append(name, **take_source.block(name, number, k, 1, images))


def touch_kpa(number, side, first, num_samples):
    rows = np.arange(first, first + num_samples)[:, None]
    columns = np.arange(320)
    return (1 + (31 * rows + 7 * number + 3 * columns + (side == "right")) % 997).astype("f4")


def joints_rad(number):
    steps = np.arange(NUM_STEPS)[:, None]
    return 0.01 * ((steps + number) % 97) + 0.001 * np.arange(JOINTS.stop - JOINTS.start)


def write_episode(store, number, images):
    actions = np.zeros((NUM_STEPS, ACTION_DIM))
    for pose in POSE_SLICES:
        actions[:, pose] = IDENTITY_POSE_9D
    actions[:, JOINTS] = joints_rad(number)
    num_touch, num_images = 4 * (NUM_STEPS - 1) + 1, 2 * (NUM_STEPS - 1) + 1
    at = take_source.image_number(CAMERA, np.arange(num_images) + number)
    plan = {
        "tactile_left": ("tactile", "kPa", 60, touch_kpa(number, "left", 0, num_touch)),
        "tactile_right": ("tactile", "kPa", 60, touch_kpa(number, "right", 0, num_touch)),
        CAMERA: ("image", "h264", 30, images[at]),
        "action": ("robot_state", "action67", 15, actions),
    }
    identity = np.eye(4)
    attributes = EpisodeAttributes(
        episode_id=take_id(number),
        task="stand_bottle",
        instruction="stand the bottle up",
        domain="robot",
        origin="twin",
        anchor=StoredAnchor.from_poses(AnchorPoses(identity, identity, identity)),
        K_head=matrix_rows(np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])),
    )
    with store.writer(attributes=attributes) as writer:
        for name, (kind, unit, rate_hz, values) in plan.items():
            writer.add_stream(
                StreamDescriptor(
                    name=name, kind=kind, shape=values.shape[1:], dtype=values.dtype.name,
                    unit=unit, nominal_rate_hz=rate_hz,
                )
            )  # fmt: skip
            stamps = np.arange(len(values), dtype=np.int64) * 1_000_000_000 // rate_hz
            writer.append(name, values=values, t_ref_ns=stamps)


class Reader:
    """Reads rows and windows of the takes that are finished."""

    def __init__(self, store, board, images, seed):
        self._store, self._board, self._images = store, board, images
        self._expected, self._rng = take_source.Expected(images), random.Random(seed)
        self.counts = {"rows": 0, "recordings": 0, "windows": 0, "gone": 0}

    def run(self):
        while not self._board.get("stop"):
            for kind, check in (
                ("recording", self.check_recording),
                ("episode", self.check_window),
            ):
                self._finished(kind, check)
        return self.counts

    def _finished(self, kind, check):
        ids = self._store.list(kind=kind)
        if not ids:
            return
        number = int(self._rng.choice(ids).removeprefix("take-"))
        try:
            check(number)
        except (NotFoundError, StorageError):
            if number >= self._board.get("first_kept"):
                raise
            self.counts["gone"] += 1

    def check_recording(self, number):
        recording = self._store.recording(take_id(number))
        assert not recording.attributes.recovered
        name = self._rng.choice(STREAM_NAMES)
        count = sum(stream == name for _, stream, _ in take_source.schedule(TAKE_SECONDS))
        assert recording.num_samples(name) == count
        self._rows(recording, name, number, count)
        self.counts["recordings"] += 1

    def _rows(self, recording, name, number, stop):
        start = max(0, stop - self._rng.randint(1, 20))
        self._expected.check(recording, name, number, start, stop)
        self.counts["rows"] += stop - start

    def check_window(self, number):
        num_steps = self._rng.randint(1, 9)
        start = self._rng.randint(0, NUM_STEPS - num_steps)
        steps = np.arange(start, start + num_steps)
        window = self._store.open(take_id(number)).window(start, num_steps, cameras=(CAMERA,))
        np.testing.assert_array_equal(window.actions[:, JOINTS], joints_rad(number)[steps])
        assert window.tactile_valid.all()
        for place, side in enumerate(("left", "right")):
            for row, step in enumerate(steps):
                first, num = (4 * step - 3, 4) if step else (0, 1)
                felt = touch_kpa(number, side, first, num).mean(axis=0, dtype=np.float64)
                np.testing.assert_array_equal(window.tactile_kpa[row, place], felt.astype("f4"))
        made = self._images[take_source.image_number(CAMERA, 2 * steps + number)]
        error = np.abs(window.images[CAMERA].astype(np.int16) - made).mean(axis=(1, 2, 3))
        assert (error < take_source.MAX_IMAGE_ERROR).all(), f"images off by {error.max():.1f}"
        self.counts["windows"] += 1


def main():
    root, board_path, images_path, role, number = sys.argv[1:]
    store, board, images = EpisodeStore(root), Board(board_path), np.load(images_path)
    if role == "record":
        found = record(store, board, images, float(number))
    else:
        found = Reader(store, board, images, int(number)).run()
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main()
