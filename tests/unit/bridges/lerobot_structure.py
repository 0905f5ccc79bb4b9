"""A folder in, what in it breaks the public LeRobotDataset v3.0 specification out, as sentences.

Written from the format's documentation, not from the bridge: paths, keys and types are spelt out
here once more, so that a change of the bridge shows.
"""

import json

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

INFO_KEYS = {
    "codebase_version",
    "fps",
    "features",
    "total_episodes",
    "total_frames",
    "total_tasks",
    "chunks_size",
    "data_files_size_in_mb",
    "video_files_size_in_mb",
    "data_path",
    "video_path",
    "robot_type",
    "splits",
}
STATISTICS = ("min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99")
INDICES = ("frame_index", "episode_index", "index", "task_index")
ARROW = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}


class Checker:
    """Collects what does not hold."""

    def __init__(self, folder):
        self.folder, self.problems = folder, []
        self.info = json.loads((folder / "meta/info.json").read_text())
        self.features = self.info.get("features", {})
        self.videos = [n for n, f in self.features.items() if f["dtype"] == "video"]

    def need(self, holds, sentence):
        if not holds:
            self.problems.append(sentence)

    def run(self):
        self.check_info()
        self.check_features()
        tasks = self.check_tasks()
        rows = self.check_episodes(tasks)
        frames = self.check_data(rows, tasks)
        for key in self.videos:
            self.check_video(key, rows)
        stats = json.loads((self.folder / "meta/stats.json").read_text())
        self.check_statistics(stats, self.info["total_frames"], "stats.json")
        self.check_values(stats, frames)

    def check_info(self):
        info = self.info
        self.need(set(info) == INFO_KEYS, f"info: keys differ by {set(info) ^ INFO_KEYS}")
        self.need(info["codebase_version"] == "v3.0", "info: codebase_version")
        self.need(type(info["fps"]) is int and info["fps"] > 0, "info: fps")
        self.need(info["splits"] == {"train": f"0:{info['total_episodes']}"}, "info: splits")
        self.need(
            info["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "info: data_path",
        )
        video = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        self.need(info["video_path"] == (video if self.videos else None), "info: video_path")

    def check_features(self):
        for name in INDICES:
            expected = {"dtype": "int64", "shape": [1], "names": None}
            self.need(self.features.get(name) == expected, f"features: {name}")
        expected = {"dtype": "float32", "shape": [1], "names": None}
        self.need(self.features.get("timestamp") == expected, "features: timestamp")
        for name, feature in self.features.items():
            self.need("/" not in name, f"features: {name} has a slash")
            self.need({"dtype", "shape", "names"} <= set(feature), f"features: {name} lacks keys")
            if isinstance(feature["names"], list) and len(feature["shape"]) == 1:
                fits = len(feature["names"]) == feature["shape"][0]
                self.need(fits, f"features: {name} has other names than numbers")
        for name in self.videos:
            feature, info = self.features[name], self.features[name].get("info", {})
            self.need(feature["names"] == ["height", "width", "channels"], f"features: {name}")
            size = [info.get("video.height"), info.get("video.width"), info.get("video.channels")]
            self.need(size == feature["shape"], f"features: {name} size")
            self.need(info.get("video.fps") == self.info["fps"], f"features: {name} fps")

    def check_tasks(self):
        table = pq.read_table(self.folder / "meta/tasks.parquet")
        self.need(sorted(table.column_names) == ["task", "task_index"], "tasks: columns")
        header = json.loads(table.schema.metadata.get(b"pandas", b"{}"))
        self.need(header.get("index_columns") == ["task"], "tasks: index of pandas")
        rows = table.to_pylist()
        order = [row["task_index"] for row in rows]
        self.need(order == list(range(self.info["total_tasks"])), "tasks: task_index")
        return [row["task"] for row in rows]

    def check_episodes(self, tasks):
        tables = {
            (int(path.parent.name[-3:]), int(path.stem[-3:])): pq.read_table(path)
            for path in sorted(self.folder.glob("meta/episodes/*/*.parquet"))
        }
        columns = tables[0, 0].column_names
        for table in tables.values():
            self.need(table.schema.names == columns, "episodes: files of other columns")
        rows, start = [row for table in tables.values() for row in table.to_pylist()], 0
        places = [place for place, table in tables.items() for _ in range(table.num_rows)]
        self.need(len(rows) == self.info["total_episodes"], "episodes: number of rows")
        for index, row in enumerate(rows):
            self.need(row["episode_index"] == index, f"episodes: row {index} is another")
            self.need(row["dataset_from_index"] == start, f"episodes: {index} starts elsewhere")
            start += row["length"]
            self.need(row["dataset_to_index"] == start, f"episodes: {index} stops elsewhere")
            self.need(set(row["tasks"]) <= set(tasks), f"episodes: {index} has unknown tasks")
            place = (row["meta/episodes/chunk_index"], row["meta/episodes/file_index"])
            self.need(place == places[index], f"episodes: {index} says another file of itself")
            nested = {name: {} for name in self.features}
            for column in columns:
                if column.startswith("stats/"):
                    feature, kind = column.removeprefix("stats/").rsplit("/", 1)
                    nested[feature][kind] = row[column]
            self.check_statistics(nested, row["length"], f"episodes: {index}")
        self.need(start == self.info["total_frames"], "episodes: total_frames")
        return rows

    def check_data(self, rows, tasks):
        paths = sorted(self.folder.glob("data/*/*.parquet"))
        tables = [pq.read_table(path) for path in paths]
        for path, table in zip(paths, tables, strict=True):
            self.check_schema(path, table)
            groups = pq.ParquetFile(path).metadata.num_row_groups
            owners = set(table.column("episode_index").to_pylist())
            self.need(groups == len(owners), f"data: {path.name} has other groups than episodes")
            for row in rows:
                said = f"chunk-{row['data/chunk_index']:03d}/file-{row['data/file_index']:03d}"
                mine = row["episode_index"] in owners
                self.need(mine == (f"{path.parent.name}/{path.stem}" == said), "data: file index")
        frames = {
            name: np.array([row for table in tables for row in table.column(name).to_pylist()])
            for name, feature in self.features.items()
            if feature["dtype"] != "video"
        }
        total = self.info["total_frames"]
        self.need(np.array_equal(frames["index"], np.arange(total)), "data: index")
        for row in rows:
            part = slice(row["dataset_from_index"], row["dataset_to_index"])
            counted = np.arange(row["length"])
            index = row["episode_index"]
            self.need((frames["episode_index"][part] == index).all(), "data: episode_index")
            self.need(np.array_equal(frames["frame_index"][part], counted), "data: frame_index")
            error = np.abs(frames["timestamp"][part] - counted / self.info["fps"])
            self.need(len(error) == row["length"] and error.max() < 1e-4, "data: timestamp")
            named = {tasks[number] for number in frames["task_index"][part]}
            self.need(named == set(row["tasks"]), "data: task_index")
        return frames

    def check_schema(self, path, table):
        names = {n for n in self.features if n not in self.videos}
        self.need(set(table.column_names) == names, f"data: {path.name} has other columns")
        for name in names & set(table.column_names):
            dtype, shape = self.features[name]["dtype"], self.features[name]["shape"]
            expected = ARROW[dtype]
            if len(shape) > 1:
                for _ in shape:
                    expected = pa.list_(expected)
            elif shape != [1]:
                expected = pa.list_(expected, shape[0])
            self.need(table.schema.field(name).type == expected, f"data: type of {name}")

    def check_video(self, key, rows):
        fps, shape = self.info["fps"], self.features[key]["shape"]
        places = {}
        for row in rows:
            place = (row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"])
            start, stop = row[f"videos/{key}/from_timestamp"], row[f"videos/{key}/to_timestamp"]
            fits = abs((stop - start) * fps - row["length"]) < 1e-6
            self.need(fits, f"video: {key} spans other frames than its episode has")
            self.need(abs(start - places.get(place, 0.0)) < 1e-9, f"video: {key} spans do not join")
            places[place] = stop
        on_disk = len(list((self.folder / "videos" / key).glob("*/*.mp4")))
        self.need(on_disk == len(places), f"video: {key} has other files than episodes say")
        starts = {}
        for row in rows:
            place = (row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"])
            starts.setdefault(place, set()).add(round(row[f"videos/{key}/from_timestamp"] * fps))
        for (chunk, file), stop in places.items():
            path = self.folder / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
            with av.open(path) as container:
                stream = container.streams.video[0]
                info = self.features[key]["info"]
                self.need(stream.codec.canonical_name == info["video.codec"], f"video: {key} codec")
                self.need(stream.pix_fmt == info["video.pix_fmt"], f"video: {key} pix_fmt")
                self.need([stream.height, stream.width, 3] == shape, f"video: {key} size")
                self.need(stream.average_rate == fps, f"video: {key} rate")
                shown = list(container.decode(stream))
                times = [float(frame.pts * stream.time_base) for frame in shown]
                keys = {round(t * fps) for f, t in zip(shown, times, strict=True) if f.key_frame}
                wanted = np.arange(round(stop * fps)) / fps
                fits = len(times) == len(wanted) and np.abs(times - wanted).max() < 1e-4
                self.need(fits, f"video: {key} holds other frames than its episodes")
                # The file's own table, which players seek by: without it all images count as keys.
                entries = {
                    round(entry.timestamp * stream.time_base * fps)
                    for entry in stream.index_entries
                    if entry.is_keyframe
                }
                fits = starts[chunk, file] <= entries
                self.need(fits, f"video: {key} cannot be entered where an episode begins")
                self.need(entries == keys, f"video: {key} promises other entry points than it has")

    def check_statistics(self, stats, count, where):
        self.need(set(stats) == set(self.features), f"{where}: statistics of other features")
        for name, feature in self.features.items():
            values = {kind: np.array(value) for kind, value in stats.get(name, {}).items()}
            self.need(set(values) == set(STATISTICS), f"{where}: {name} lacks statistics")
            if set(values) != set(STATISTICS):
                continue
            is_video = feature["dtype"] == "video"
            shape = (3, 1, 1) if is_video else (feature["shape"][-1],)
            for kind in STATISTICS[:4] + STATISTICS[5:]:
                self.need(values[kind].shape == shape, f"{where}: shape of {name} {kind}")
            self.need(values["count"].shape == (1,), f"{where}: shape of {name} count")
            seen = int(values["count"][0])
            self.need(0 < seen <= count if is_video else seen == count, f"{where}: {name} count")
            order = np.stack([values[k] for k in ("min", *STATISTICS[5:], "max")])
            self.need((np.diff(order, axis=0) >= -1e-9).all(), f"{where}: {name} out of order")
            if is_video:
                self.need(order.min() >= 0 and order.max() <= 1, f"{where}: {name} not in 0 … 1")

    def check_values(self, stats, frames):
        for name, values in frames.items():
            rows = values.astype(np.float64).reshape(-1, self.features[name]["shape"][-1])
            plain = {
                "min": rows.min(0),
                "max": rows.max(0),
                "mean": rows.mean(0),
                "std": rows.std(0),
            }
            for kind, expected in plain.items():
                scale = max(1e-12, float(np.abs(rows).max()))
                error = np.abs(np.array(stats[name][kind]) - expected).max() / scale
                self.need(error < 1e-6, f"stats.json: {name} {kind} is not that of the data")


def problems(folder):
    """Sentences about all that does not hold; empty for a sound dataset."""
    checker = Checker(folder)
    try:
        checker.run()
    except (KeyError, ValueError, IndexError) as error:
        checker.problems.append(f"could not be checked to the end: {error!r}")
    return checker.problems
