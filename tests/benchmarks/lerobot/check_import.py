"""A dataset that lerobot's own writer made → what our import finds in it, frame by frame.

`make check-lerobot-export` runs it in the environment of the benchmark; its exit status is 1 where
the import refuses the dataset, or holds other numbers, texts, images, times or tasks than were
written.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from check_export import MismatchError, require
from environment import enter

REPO = "local/import"
FPS = 10
LENGTHS = (14, 9)
TASKS = ("pick the cube", "place the cube")
SIZE_PX = (96, 128)
JOINTS = ["waist", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper"]
CAMERAS = {
    "observation.images.top": "video",
    "observation.images.side": "video",
    "observation.images.wrist": "image",
}
LEAST_PSNR_DB = 25.0


def main() -> int:
    """Write with each codec, import and compare; 0 when all agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory(prefix="dextouch-import-") as folder:
        enter(Path(folder) / "cache")
        for codec in ("libsvtav1", "h264"):
            try:
                found = check(codec, Path(folder) / codec)
            except MismatchError as error:
                failed += 1
                found = f"FAIL {error}"
            sys.stdout.write(f"written by lerobot with {codec}: {found}\n")
        try:
            found = check_conversion(Path(folder) / "arm")
        except MismatchError as error:
            failed += 1
            found = f"FAIL {error}"
        sys.stdout.write(f"v2.1, and converted to v3.0 by lerobot: {found}\n")
    return 1 if failed else 0


def frames(episode: int) -> list[dict[str, object]]:
    """The frames of an episode as lerobot's writer takes them."""
    rng = np.random.default_rng(episode)
    rows, columns = np.mgrid[: SIZE_PX[0], : SIZE_PX[1]]
    made = []
    for index in range(LENGTHS[episode]):
        frame: dict[str, object] = {
            "action": rng.normal(size=7).astype(np.float32),
            "observation.state": rng.normal(size=9).astype(np.float32),
            "observation.force": rng.normal(size=(2, 3)).astype(np.float32),
            "observation.touching": np.array([index % 3 == 0]),
            "subtask": ("reach", "grasp", "lift")[index % 3],
            "task": TASKS[index * 2 // LENGTHS[episode]] if episode else TASKS[0],
        }
        for number, key in enumerate(CAMERAS):
            phase = 0.3 * index + number + 5 * episode
            waves = [
                128 + 100 * np.sin(rows / 11 + columns / 17 + phase + colour) for colour in range(3)
            ]
            frame[key] = np.stack(waves, axis=-1).astype(np.uint8)
        made.append(frame)
    return made


def write(codec: str, folder: Path) -> None:
    """Write two episodes with lerobot."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = ["height", "width", "channels"]
    features = {
        "action": {"dtype": "float32", "shape": (7,), "names": JOINTS},
        "observation.state": {"dtype": "float32", "shape": (9,), "names": None},
        "observation.force": {"dtype": "float32", "shape": (2, 3), "names": None},
        "observation.touching": {"dtype": "bool", "shape": (1,), "names": None},
        "subtask": {"dtype": "string", "shape": (1,), "names": None},
        **{k: {"dtype": d, "shape": (*SIZE_PX, 3), "names": names} for k, d in CAMERAS.items()},
    }
    dataset = LeRobotDataset.create(
        REPO, fps=FPS, features=features, root=folder, rgb_encoder=RGBEncoderConfig(vcodec=codec)
    )
    for episode in range(len(LENGTHS)):
        for frame in frames(episode):
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()


def check(codec: str, folder: Path) -> str:
    """Write a dataset, import it and compare every frame; a line for the reader comes back.

    Raises:
        MismatchError: where the import holds something else.
    """
    from dextouch.bridges.lerobot import import_dataset
    from dextouch.episodes import EpisodeStore

    write(codec, folder)
    store = EpisodeStore(folder.with_name(f"{codec}-store"))
    result = import_dataset(folder, store)
    require("kind", result.kind, "recording")
    lowest_db = np.inf
    for episode, report in enumerate(result.reports):
        require("refused", report.refused, [])
        require("contradictions", report.contradictions, [])
        recording = store.recording(report.recording_id)
        recording.verify()
        written = frames(episode)
        check_numbers(recording, written)
        check_tasks(recording, [str(frame["task"]) for frame in written])
        for key, dtype in CAMERAS.items():
            name = key.replace(".", "_")
            images = recording.images(name).astype(np.float64)
            errors = np.array([np.mean((images - f[key]) ** 2, axis=(1, 2, 3)) for f in written])
            require(f"{key}: order", errors.argmin(axis=0).tolist(), list(range(len(written))))
            if dtype == "image":
                require(f"{key}: largest error", float(np.diag(errors).max()), 0.0)
            else:
                worst = max(1e-3, float(np.diag(errors).max()))
                lowest_db = min(lowest_db, float(10 * np.log10(255**2 / worst)))
    if lowest_db < LEAST_PSNR_DB:
        raise MismatchError(f"video of {lowest_db:.1f} dB, expected at least {LEAST_PSNR_DB:g}")
    return (
        f"{sum(LENGTHS)} frames of {len(LENGTHS)} episodes, numbers and PNG images equal, "
        f"videos at least {lowest_db:.1f} dB (bound {LEAST_PSNR_DB:g})"
    )


def check_conversion(folder: Path) -> str:
    """Import a v2.1 dataset before and after lerobot's own conversion to v3.0, and compare.

    Raises:
        MismatchError: where the two imports differ.
    """
    from foreign_lerobot import arm
    from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset

    from dextouch.bridges.lerobot import ImportOptions, import_dataset
    from dextouch.episodes import EpisodeStore

    store = EpisodeStore(folder.with_name("arm-store"))
    arm().write_v21(folder)
    before = import_dataset(folder, store)
    convert_dataset(REPO, root=folder, push_to_hub=False)
    after = import_dataset(folder, store, options=ImportOptions(id_prefix="v3-"))
    num_compared = 0
    for one, other in zip(before.ids, after.ids, strict=True):
        old, new = store.recording(one), store.recording(other)
        require("streams", set(new.streams), set(old.streams))
        require("task", new.attributes.task, old.attributes.task)
        for name, stream in old.streams.items():
            require(f"{name}: times", new.stamps_ns(name).tolist(), old.stamps_ns(name).tolist())
            is_image = stream.kind == "image"
            got, expected = (
                r.images(name) if is_image else r.values(name, 0, r.num_samples(name))
                for r in (new, old)
            )
            require(f"{name}: values", np.array_equal(got, expected), expected=True)
            num_compared += 1
    return f"{num_compared} streams of {len(before.ids)} episodes equal"


def check_numbers(recording, written) -> None:
    """Compare numbers, names, texts and times of a recording with the frames that were written."""
    for key in ("action", "observation.state", "observation.force", "observation.touching"):
        name = key.replace(".", "_")
        got = recording.values(name, 0, len(written))
        expected = np.stack([np.asarray(frame[key]) for frame in written])
        require(key, np.array_equal(got, expected), expected=True)
        times = np.rint(np.arange(len(written)) * (1e9 / FPS)).astype(np.int64)
        require(f"{key}: times", recording.stamps_ns(name).tolist(), times.tolist())
    require("names", list(recording.streams["action"].names), JOINTS)
    require("subtask", texts(recording, "subtask"), [frame["subtask"] for frame in written])


def check_tasks(recording, tasks: list[str]) -> None:
    """Compare the tasks: the only one of an episode, or that of each frame."""
    if len(set(tasks)) == 1:
        require("instruction", recording.attributes.instruction, tasks[0])
    else:
        require("tasks", texts(recording, "task"), tasks)


def texts(recording, name: str) -> list[str]:
    """The texts of a stream."""
    rows = recording.values(name, 0, recording.num_samples(name))
    return [bytes(row).rstrip(b"\0").decode() for row in rows]


if __name__ == "__main__":
    sys.exit(main())
