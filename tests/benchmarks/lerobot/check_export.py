"""Episodes exported by our bridge → what lerobot's own reader finds in them, frame by frame.

`make check-lerobot-export` runs it in the environment of the benchmark; its exit status is 1 where
lerobot cannot open an export or finds other images, actions, times or tasks than were written.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from environment import enter

REPO = "local/export"
NUM_EPISODES = 2
WINDOW = 5


@dataclass(frozen=True)
class Case:
    """One way to export: cameras of a unit, at a rate; how near images and actions must come.

    With `grown` the second episode is appended, and every touch sample goes along.
    """

    unit: str
    fps: int
    least_psnr_db: float
    action_error: float
    grown: bool = False

    @property
    def name(self) -> str:
        return f"{self.unit} at {self.fps} Hz{', appended' * self.grown}"


# Video that is copied differs only by the decoder's way to RGB; what is encoded anew loses more.
# On the model grid (15 Hz) actions are copied; elsewhere they pass through poses, also at steps.
CASES = (
    Case("h264", 30, 40.0, 1e-6),
    Case("h264", 15, 25.0, 0.0),
    Case("jpeg", 15, 25.0, 0.0),
    Case("rgb8", 15, 25.0, 0.0),
    Case("h264", 30, 40.0, 1e-6, grown=True),
    Case("jpeg", 15, 25.0, 0.0, grown=True),
)


class MismatchError(Exception):
    """lerobot found something else than was written."""


def main() -> int:
    """Check every case; 0 when all agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory(prefix="dextouch-export-") as folder:
        enter(Path(folder) / "cache")
        for index, case in enumerate(CASES):
            try:
                found = check(case, Path(folder) / str(index))
            except MismatchError as error:
                failed += 1
                found = f"FAIL {error}"
            sys.stdout.write(f"{case.name}: {found}\n")
    return 1 if failed else 0


def check(case: Case, folder: Path) -> str:
    """Export two episodes and compare every frame; a line for the reader comes back.

    Raises:
        MismatchError: where lerobot finds something else.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from takes import CAMERAS, write_episode

    from dextouch.bridges.lerobot import ExportOptions, export_dataset
    from dextouch.episodes import EpisodeStore

    store = EpisodeStore(folder / "store")
    readers = [
        write_episode(store, f"take-{index}", unit=case.unit, seed=3 + index)
        for index in range(NUM_EPISODES)
    ]
    num_frames = 0
    for part in (readers[:1], readers) if case.grown else (readers,):
        options = ExportOptions(
            fps=case.fps, touch_samples=case.grown, license_name="cc-by-4.0", existing="append"
        )
        done = export_dataset(part, folder / "dataset", repo_id=REPO, options=options)
        num_frames += done.num_frames
    dataset = LeRobotDataset(REPO, root=folder / "dataset", return_uint8=True)
    require("frames", len(dataset), num_frames)
    require("episodes", dataset.num_episodes, NUM_EPISODES)
    require("rate", dataset.fps, case.fps)
    psnrs, num_actions = [], 0
    for index in range(num_frames):
        item = dataset[index]
        reader = readers[int(item["episode_index"])]
        num_actions += check_numbers(item, reader, case, f"frame {index}")
        if case.grown:
            check_touch(item, reader, f"frame {index}")
        psnrs += [check_image(item, reader, camera, case) for camera in CAMERAS]
    if num_actions < sum(reader.num_steps for reader in readers):
        raise MismatchError(
            f"got actions of {num_actions} steps, expected every step of every episode"
        )
    check_window(folder / "dataset", dataset, case)
    check_card(folder / "dataset")
    return (
        f"{num_frames} frames of {NUM_EPISODES} episodes, {num_actions} actions within "
        f"{case.action_error:g}, images at least {min(psnrs):.1f} dB (bound {case.least_psnr_db:g})"
    )


def check_numbers(item, reader, case: Case, where: str) -> int:
    """Compare times, task and action of a frame; 1 comes back where it lies on a step."""
    from dextouch.hands.actions import actions_from_poses, poses_from_actions

    seconds = int(item["frame_index"]) / case.fps
    if abs(float(item["timestamp"]) - seconds) > 1e-4:
        raise MismatchError(
            f"{where}: got timestamp {float(item['timestamp'])}, expected {seconds}"
        )
    require(f"{where}: task", item["task"], reader.attributes.instruction)
    sent = reader.read("action_commanded")
    steps = np.flatnonzero(sent.t_ref_ns == int(item["dextouch.t_ref_ns"]))
    if not len(steps):
        return 0
    values = sent.values[steps]
    if case.fps != reader.attributes.model_rate_hz:
        # The takes' commands are no exact rotations until they have passed through poses.
        anchor = reader.attributes.anchor.to_poses()
        values = actions_from_poses(poses_from_actions(values, anchor), anchor)
    expected = values[0].astype(np.float32)
    error = float(np.abs(item["action"].numpy() - expected).max())
    if not error <= case.action_error:
        raise MismatchError(
            f"{where}: action differs by {error:.2g} from that of step {steps[0]}, "
            f"expected at most {case.action_error:g}"
        )
    return 1


def check_touch(item, reader, where: str) -> None:
    """Compare the touch samples of a frame with those that the episode has at their times."""
    for hand, side in enumerate(("left", "right")):
        data = reader.read(f"tactile_{side}")
        count = int(item["dextouch.tactile_samples_count"][hand])
        offsets_ns = item["dextouch.tactile_samples_dt_ns"][:count, hand].numpy()
        rows = np.searchsorted(data.t_ref_ns, int(item["dextouch.t_ref_ns"]) + offsets_ns)
        got = item["observation.tactile_samples"][:count, hand].numpy()
        require(f"{where}: touch {side}", np.array_equal(got, data.values[rows]), expected=True)


def check_card(folder: Path) -> None:
    """Read the dataset's card with the Hub's own reader."""
    from huggingface_hub import DatasetCard

    data = DatasetCard.load(folder / "README.md").data
    require("licence of the card", data.license, "cc-by-4.0")
    require("tasks of the card", data.task_categories, ["robotics"])
    require("first tag of the card", data.tags[0], "LeRobot")


def check_image(item, reader, camera: str, case: Case) -> float:
    """Compare an image with all stored ones; its PSNR in dB against the right one comes back."""
    stored = reader.read(camera)
    nearest = int(np.abs(stored.t_ref_ns - int(item["dextouch.t_ref_ns"])).argmin())
    image = np.moveaxis(item[f"observation.images.{camera}"].numpy(), 0, -1)
    errors = np.mean((stored.values - image.astype(np.float64)) ** 2, axis=(1, 2, 3))
    where = f"{camera} at {int(item['dextouch.t_ref_ns'])} ns"
    # Neighbours are so alike that a fidelity alone would not tell them apart.
    require(f"{where}: most similar stored image", int(errors.argmin()), nearest)
    psnr_db = float(10 * np.log10(255**2 / max(errors[nearest], 1e-3)))
    if psnr_db < case.least_psnr_db:
        raise MismatchError(
            f"{where}: got {psnr_db:.1f} dB against the stored image, expected at least "
            f"{case.least_psnr_db:g}"
        )
    return psnr_db


def check_window(folder: Path, frames, case: Case) -> None:
    """Compare lerobot's windows of images and actions with its single frames."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    image = frames.meta.camera_keys[0]
    offsets_s = [index / case.fps for index in range(WINDOW)]
    deltas = {image: offsets_s, "action": offsets_s}
    windows = LeRobotDataset(REPO, root=folder, delta_timestamps=deltas, return_uint8=True)
    for start in (0, len(frames) - WINDOW):
        window = windows[start]
        for offset in range(WINDOW):
            single = frames[start + offset]
            for key in deltas:
                if not np.array_equal(window[key][offset].numpy(), single[key].numpy()):
                    raise MismatchError(
                        f"window at {start}: {key} {offset} is not that of its frame"
                    )


def require(what: str, got: object, expected: object) -> None:
    """Raise where two things differ."""
    if got != expected:
        raise MismatchError(f"{what}: got {got!r}, expected {expected!r}")


if __name__ == "__main__":
    sys.exit(main())
