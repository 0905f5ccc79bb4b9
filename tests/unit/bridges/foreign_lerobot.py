"""LeRobot datasets as others write them, from the public descriptions of v3.0 and v2.1.

v3.0: https://huggingface.co/docs/lerobot/lerobot-dataset-v3; v2.1: the layout that the section
"Migrate v2.1 to v3.0" there describes, and the cards of datasets of that version on the Hub.
Nothing of the bridge is used: paths and fields are spelt out here.
"""

import json
from dataclasses import dataclass, field

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

JOINTS = ["waist", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper"]
SIZE_PX = (48, 64)
FPS = 10
LENGTHS = (12, 9)
TASKS = ("pick the cube", "place the cube", "wave")
NUMBER = {"shape": [1], "names": None}
COUNTERS = {
    "timestamp": {"dtype": "float32", **NUMBER},
    **{n: {"dtype": "int64", **NUMBER} for n in ("frame_index", "episode_index", "index")},
    "task_index": {"dtype": "int64", **NUMBER},
}


def picture(index, seed=0):
    """A smooth image that differs from frame to frame."""
    rows, columns = np.mgrid[: SIZE_PX[0], : SIZE_PX[1]]
    phase = 0.4 * index + seed
    waves = [128 + 100 * np.sin(rows / 9 + columns / 14 + phase + c) for c in range(3)]
    return np.stack(waves, axis=-1).astype(np.uint8)


def encoded(image, suffix):
    return cv2.imencode(suffix, image[..., ::-1])[1].tobytes()


def write_video(path, images, fps, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=fps)
        stream.height, stream.width = SIZE_PX
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "10", **options}
        for image in images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode())


@dataclass
class Foreign:
    """One dataset: features beside the counters, with the values of each episode's frames.

    `values` are lists by feature and episode; `cameras` has for a feature how its images are kept:
    `video`, or `image` with the suffix of their files and their place, `inside` the data file or
    `apart` from it.
    """

    features: dict
    values: dict
    cameras: dict = field(default_factory=dict)
    tasks: tuple = ((0,), (1,))
    lengths: tuple = LENGTHS
    fps: int = FPS
    video_options: dict = field(default_factory=dict)

    def images(self, key, episode):
        seed = sorted(self.cameras).index(key) + 10 * episode
        return [picture(index, seed) for index in range(self.lengths[episode])]

    def info(self, version, **more):
        described = dict(self.features)
        for key, (dtype, *_) in self.cameras.items():
            shape, names = [*SIZE_PX, 3], ["height", "width", "channels"]
            described[key] = {"dtype": dtype, "shape": shape, "names": names}
        return {
            "codebase_version": version,
            "robot_type": "arm7",
            "total_episodes": len(self.lengths),
            "total_frames": sum(self.lengths),
            "total_tasks": len(TASKS),
            "chunks_size": 1000,
            "fps": self.fps,
            "splits": {"train": f"0:{len(self.lengths)}"},
            **more,
            "features": described | COUNTERS,
        }

    def table(self, folder, episode):
        count, start = self.lengths[episode], sum(self.lengths[:episode])
        tasks = self.tasks[episode]
        columns = {
            "timestamp": pa.array(np.arange(count, dtype=np.float32) / np.float32(self.fps)),
            "frame_index": pa.array(np.arange(count)),
            "episode_index": pa.array(np.full(count, episode)),
            "index": pa.array(start + np.arange(count)),
            "task_index": pa.array([tasks[k * len(tasks) // count] for k in range(count)]),
        }
        for key, values in self.values.items():
            columns[key] = pa.array(values[episode], _arrow(self.features[key]))
        for key, (dtype, *how) in self.cameras.items():
            if dtype == "image":
                columns |= self._image_column(folder, key, episode, *how)
        return pa.table(columns)

    def _image_column(self, folder, key, episode, suffix, place="inside"):
        form = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        rows = []
        for index, image in enumerate(self.images(key, episode)):
            name = f"images/{key}/episode_{episode:06d}/frame_{index:06d}{suffix}"
            rows.append(
                {"bytes": encoded(image, suffix) if place == "inside" else None, "path": name}
            )
            if place == "apart":
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(encoded(image, suffix))
        return {key: pa.array(rows, form)}

    def write_v3(self, folder):
        """All episodes in one data file, and one video for each camera."""
        info = self.info(
            "v3.0",
            data_files_size_in_mb=100,
            video_files_size_in_mb=200,
            data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            video_path="videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        )
        tables = [self.table(folder, episode) for episode in range(len(self.lengths))]
        _write(folder / "data/chunk-000/file-000.parquet", pa.concat_tables(tables))
        rows, start = [], 0
        for episode, count in enumerate(self.lengths):
            row = {
                "episode_index": episode,
                "tasks": [TASKS[number] for number in self.tasks[episode]],
                "length": count,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": start,
                "dataset_to_index": start + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for key in self._videos():
                row |= {
                    f"videos/{key}/chunk_index": 0,
                    f"videos/{key}/file_index": 0,
                    f"videos/{key}/from_timestamp": start / self.fps,
                    f"videos/{key}/to_timestamp": (start + count) / self.fps,
                }
            rows.append(row)
            start += count
        _write(folder / "meta/episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(rows))
        listed = {"task_index": list(range(len(TASKS))), "__index_level_0__": list(TASKS)}
        _write(folder / "meta/tasks.parquet", pa.table(listed))
        for key in self._videos():
            every = [i for episode in range(len(self.lengths)) for i in self.images(key, episode)]
            path = folder / f"videos/{key}/chunk-000/file-000.mp4"
            write_video(path, every, self.fps, **self.video_options)
        (folder / "meta/info.json").write_text(json.dumps(info))
        return folder

    def write_v21(self, folder):
        """A data file and videos for each episode, and descriptions with one object a line."""
        info = self.info(
            "v2.1",
            total_videos=len(self._videos()) * len(self.lengths),
            total_chunks=1,
            data_path="data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            video_path="videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        )
        lines = []
        for episode, count in enumerate(self.lengths):
            path = folder / f"data/chunk-000/episode_{episode:06d}.parquet"
            _write(path, self.table(folder, episode))
            texts = [TASKS[number] for number in self.tasks[episode]]
            lines.append({"episode_index": episode, "tasks": texts, "length": count})
            for key in self._videos():
                path = folder / f"videos/chunk-000/{key}/episode_{episode:06d}.mp4"
                write_video(path, self.images(key, episode), self.fps, **self.video_options)
        meta = folder / "meta"
        meta.mkdir(exist_ok=True)
        tasks = [{"task_index": k, "task": text} for k, text in enumerate(TASKS)]
        stats = [self._statistics(episode) for episode in range(len(self.lengths))]
        for name, rows in (("episodes", lines), ("tasks", tasks), ("episodes_stats", stats)):
            text = "".join(json.dumps(row) + "\n" for row in rows)
            (meta / f"{name}.jsonl").write_text(text)
        (meta / "info.json").write_text(json.dumps(info))
        return folder

    def _statistics(self, episode):
        found = {}
        for key, feature in self.features.items():
            if feature["dtype"] != "string":
                rows = np.array(self.values[key][episode], dtype=float).reshape(
                    self.lengths[episode], -1, feature["shape"][-1]
                )
                found[key] = {
                    kind: getattr(rows, kind)(axis=(0, 1)).tolist()
                    for kind in ("min", "max", "mean", "std")
                } | {"count": [self.lengths[episode]]}
        return {"episode_index": episode, "stats": found}

    def _videos(self):
        return [key for key, (dtype, *_) in self.cameras.items() if dtype == "video"]


def _write(path, table):
    path.parent.mkdir(parents=True, exist_ok=True)
    # Row groups that end within episodes.
    pq.write_table(table, path, row_group_size=5)


def _arrow(feature):
    kinds = {"string": pa.string(), "bool": pa.bool_(), "float32": pa.float32()}
    kind = kinds.get(feature["dtype"]) or pa.from_numpy_dtype(feature["dtype"])
    if feature["dtype"] != "string" and feature["shape"] != [1]:
        for _ in feature["shape"]:
            kind = pa.list_(kind)
    return kind


def arm(**changes):
    """A robot arm with seven joints, two cameras and features of every kind."""
    rng = np.random.default_rng(5)

    def rows(*shape):
        return [rng.normal(size=(n, *shape)).astype(np.float32).tolist() for n in LENGTHS]

    features = {
        "action": {"dtype": "float32", "shape": [7], "names": JOINTS},
        "observation.state": {
            "dtype": "float32",
            "shape": [9],
            "names": {"motors": list("abcdefghi")},
        },
        "observation.force": {"dtype": "float32", "shape": [2, 3], "names": None},
        "observation.count": {"dtype": "int16", "shape": [1], "names": None},
        "next.done": {"dtype": "bool", "shape": [1], "names": None},
        "subtask": {"dtype": "string", "shape": [1], "names": None},
    }
    values = {
        "action": rows(7),
        "observation.state": rows(9),
        "observation.force": rows(2, 3),
        "observation.count": [list(range(-3, n - 3)) for n in LENGTHS],
        "next.done": [[k == n - 1 for k in range(n)] for n in LENGTHS],
        "subtask": [[("reach", "grüße", "")[k % 3] for k in range(n)] for n in LENGTHS],
    }
    cameras = {"observation.images.top": ("video",), "observation.images.wrist": ("image", ".png")}
    return Foreign(features, values, **({"cameras": cameras} | changes))
