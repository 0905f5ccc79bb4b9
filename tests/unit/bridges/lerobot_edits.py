"""Changes of a dataset on disk: one value of a JSON file, one column of a table."""

import json

import pyarrow as pa
import pyarrow.parquet as pq

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"
INFO = "meta/info.json"
STATS = "meta/stats.json"


def edit_json(folder, name, change):
    path = folder / name
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_column(folder, name, column, change):
    """Replace a column's values by those of `change`, keeping its type."""
    table = pq.read_table(folder / name)
    values, place = table.column(column).to_pylist(), table.column_names.index(column)
    change(values)
    changed = pa.array(values, table.schema.field(column).type)
    pq.write_table(table.set_column(place, column, changed), folder / name)


def drop_columns(folder, name, *columns):
    table = pq.read_table(folder / name)
    pq.write_table(table.drop_columns(list(columns)), folder / name)


def rename_columns(folder, name, rename):
    table = pq.read_table(folder / name)
    pq.write_table(table.rename_columns([rename(c) for c in table.column_names]), folder / name)


def set_item(index, value):
    def change(values):
        values[index] = value

    return change


def cut_file(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
