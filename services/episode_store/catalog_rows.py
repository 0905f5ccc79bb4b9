"""Rows of a catalog: what is read of an item, how items are linked, and how unusual each is."""

import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
import structlog

from dextouch import episodes, schemas
from dextouch.episodes import EpisodeReader, EpisodeStore, GroupFingerprint, Kind, RecordingReader
from dextouch.errors import CorruptDataError
from services.episode_store.filters import (
    EQUALITY_FILTERS,
    NO_WEIGHT,
    WEIGHTS,
    item_name,
    microseconds,
    number_key,
    time_key,
    within_calendar,
)
from services.episode_store.items import (
    FIGURES,
    MIN_ITEMS,
    figure_row,
    item_of,
    outlier_scores,
    spread_of,
)

logger = structlog.get_logger(__name__)

# Most items have no findings, or those of one weight.
_weight_key = lru_cache(maxsize=1 << 12)(number_key)
# Sources and products of an item are found by kind, id and hash, where that is known. A unary
# plus and CROSS JOIN keep SQLite from beginning with all items of a kind.
_SOURCES: Final = """FROM lineage l JOIN item s ON s.kind = l.kind AND s.id = l.source
  AND (l.sha256 IS NULL OR l.sha256 = s.sha256) WHERE l.row = item.row"""
# The review of an edit counts as long as one of the results is stored (`Review.standing`).
_STAND: Final = """UPDATE item SET stands = NOT is_superseded OR EXISTS (
  SELECT 1 FROM result r JOIN item p ON p.kind = item.kind AND p.id = r.id WHERE r.row = item.row)
  WHERE is_dirty"""
_OWN_VERDICT: Final = "iif(stands, own_verdict, earlier_verdict)"
_LINK_EPISODES: Final = f"""UPDATE item SET
  is_take = origin = 'imagined' OR NOT EXISTS (SELECT 1 {_SOURCES} AND s.kind = 'recording'),
  verdict = coalesce({_OWN_VERDICT}, (SELECT 'rejected' {_SOURCES}
    AND iif(s.is_superseded, s.earlier_verdict, s.own_verdict) = 'rejected' LIMIT 1)),
  is_whole = complete AND NOT EXISTS (SELECT 1 {_SOURCES} AND s.kind = 'recording'
    AND NOT s.complete)
  WHERE is_dirty AND +kind = 'episode'"""
# What changes with an episode may change the takes of its recordings.
_MARK_RECORDINGS: Final = """UPDATE item SET is_dirty = 1 WHERE kind = 'recording' AND id IN (
  SELECT l.source FROM item e CROSS JOIN lineage l ON l.row = e.row
  WHERE e.is_dirty AND +e.kind = 'episode' AND l.kind = 'recording')"""
_LINK_RECORDINGS: Final = f"""UPDATE item SET
  is_take = 1, verdict = {_OWN_VERDICT}, is_whole = complete,
  aligned = (SELECT p.row FROM lineage l CROSS JOIN item p ON p.row = l.row
    WHERE l.source = item.id AND l.kind = 'recording'
      AND (l.sha256 IS NULL OR l.sha256 = item.sha256)
      AND p.kind = 'episode' AND p.origin <> 'imagined' ORDER BY p.id DESC LIMIT 1)
  WHERE is_dirty AND +kind = 'recording'"""
_JUDGE: Final = f"""UPDATE item SET
  is_compared = aligned IS NULL AND verdict IS NOT 'rejected',
  fixed = CASE WHEN NOT is_whole THEN {WEIGHTS["incomplete"]}
    WHEN beyond_limit THEN {WEIGHTS["beyond_limit"]}
    WHEN in_doubt THEN {WEIGHTS["doubtful_clock"]}
    WHEN recovered THEN {WEIGHTS["recovered"]}
    WHEN success IS NULL AND origin = 'recorded' THEN {WEIGHTS["not_judged"]} ELSE 0 END
  WHERE is_dirty"""
_TAKES: Final = """UPDATE item SET is_dirty = 0,
  take_verdict = coalesce((SELECT a.verdict FROM item a WHERE a.row = item.aligned), verdict),
  take_weight = coalesce((SELECT a.weight FROM item a WHERE a.row = item.aligned), weight)
  WHERE is_dirty"""


@dataclass(frozen=True)
class ItemRow:
    """What a catalog keeps of an item: columns of `item` and `body`, lineage, quality, results."""

    item: Mapping[str, object]
    body: Mapping[str, object]
    lineage: tuple[schemas.LineageEntry, ...]
    quality: Mapping[str, float]
    results: tuple[str, ...]


def read_row(
    store: EpisodeStore, kind: Kind, item_id: str, fingerprint: GroupFingerprint
) -> ItemRow:
    """Read an item; raises as `EpisodeStore.open`."""
    reader = store.open_item(kind, item_id)
    about = reader.attributes
    summary: schemas.EpisodeSummary | schemas.RecordingSummary
    if isinstance(reader, EpisodeReader):
        summary, at = _episode(reader), reader.attributes.created_at
    else:
        summary, at = _recording(store, reader), reader.attributes.started_at
    at = at and within_calendar(at)
    item = item_of(reader, summary)
    is_clickable = isinstance(reader, EpisodeReader) and _is_clickable(reader)
    review, clicks = None, None
    # Without its stamp there is none.
    if fingerprint.remarks.strip():
        review, clicks = read_remarks(store, kind, item_id)
    parts = (item_id, about.task, about.instruction, about.operator, about.station, about.trace_id)
    names = ("kind", "id", *EQUALITY_FILTERS, "complete", "duration_s")
    columns: dict[str, object] = {name: getattr(item, name) for name in names}
    columns |= fingerprint._asdict() | {
        "name": item_name(item_id, kind),
        "sha256": reader.content_sha256,
        "at_us": None if at is None else microseconds(at),
        "at_key": time_key(at),
        "duration_key": number_key(item.duration_s),
        "size": summary.num_steps
        if isinstance(summary, schemas.EpisodeSummary)
        else sum(summary.num_samples.values()),
        "num_bytes": summary.num_bytes if isinstance(summary, schemas.RecordingSummary) else None,
        "beyond_limit": bool(item.findings),
        "in_doubt": bool(item.time_doubts),
        "is_clickable": is_clickable,
        **_verdicts(review),
        "figures": figure_row(item.figures).tobytes(),
        "text": "\n".join(part or "" for part in parts).casefold(),
    }
    body = {
        "summary": summary.model_dump_json(),
        "item": item.model_dump_json(),
        "consent": item.consent,
        "incomplete_cause": item.incomplete_cause,
        "review": _json(review),
        "clicks": _json(clicks),
    }
    results = () if review is None else review.superseded_by
    return ItemRow(columns, body, about.lineage, about.quality, results)


def read_remarks(
    store: EpisodeStore, kind: Kind, item_id: str
) -> tuple[schemas.Review | None, schemas.EpisodeClicks | None]:
    """Review of an item and clicks of an episode; None, with a line of the log, if damaged."""
    review, clicks = None, None
    for name in ("review", "clicks")[: 1 + (kind == "episode")]:
        try:
            if name == "review":
                review = store.review(item_id, kind=kind)
            else:
                clicks = store.clicks(item_id)
        except CorruptDataError as error:
            logger.warning("remark_unreadable", kind=kind, id=item_id, reason=error.message)
    return review, clicks


def _episode(reader: EpisodeReader) -> schemas.EpisodeSummary:
    attributes, num_steps = reader.attributes, reader.num_steps
    return schemas.EpisodeSummary(
        episode_id=reader.item_id,
        origin=attributes.origin,
        num_steps=num_steps,
        duration_s=num_steps / attributes.model_rate_hz or _nominal_duration_s(reader),
        lineage=attributes.lineage,
        created_at=attributes.created_at,
        **_shared_fields(reader),
    )


def _recording(store: EpisodeStore, reader: RecordingReader) -> schemas.RecordingSummary:
    attributes = reader.attributes
    return schemas.RecordingSummary(
        recording_id=reader.item_id,
        consent=attributes.consent,
        num_samples={name: reader.num_samples(name) for name in reader.streams},
        duration_s=_nominal_duration_s(reader),
        num_bytes=store.num_bytes(reader.item_id, kind="recording"),
        started_at=attributes.started_at,
        **_shared_fields(reader),
    )


def _is_clickable(reader: EpisodeReader) -> bool:
    """Whether training would take an episode if its objects were clicked."""
    about = reader.attributes
    if about.origin != "recorded" or about.success is None or about.recovered:
        return False
    has_images = reader.num_steps > 0 and "camera_head" in reader.streams
    return has_images and not episodes.has_object_poses(reader)


def _shared_fields(reader: EpisodeReader | RecordingReader) -> dict[str, Any]:
    """The fields that the summaries of both kinds have under one name."""
    names = schemas.EpisodeSummary.model_fields.keys() & schemas.SHARED_ATTRIBUTES
    fields = {name: getattr(reader.attributes, name) for name in names}
    return fields | {"content_sha256": reader.content_sha256}


def _nominal_duration_s(reader: EpisodeReader | RecordingReader) -> float:
    # Counts come from the commit record, so no array is opened.
    rates_hz = {name: stream.nominal_rate_hz for name, stream in reader.streams.items()}
    return max((reader.num_samples(name) / rates_hz[name] for name in rates_hz), default=0.0)


def write_row(connection: sqlite3.Connection, row: ItemRow) -> None:
    """Put an item in the place of an earlier one of its name; `relink` must follow."""
    execute = connection.execute
    execute("DELETE FROM item WHERE kind = :kind AND id = :id", row.item)
    (group,) = execute(
        "INSERT INTO grp (task, domain, origin, kind) VALUES (:task, :domain, :origin, :kind) "
        "ON CONFLICT DO UPDATE SET kind = kind RETURNING number",
        row.item,
    ).fetchone()
    number = _insert(connection, "item", {**row.item, "grp": group})
    _insert(connection, "body", {"row": number, **row.body})
    connection.executemany(
        "INSERT INTO lineage VALUES (?, ?, ?, ?, ?)",
        [(number, place, one.kind, one.id, one.sha256) for place, one in enumerate(row.lineage)],
    )
    _insert_results(connection, number, row.results)
    known = dict(execute("SELECT name, number FROM figure_name"))
    for name in row.quality.keys() - known.keys():
        known[name] = execute("INSERT INTO figure_name (name) VALUES (?)", (name,)).lastrowid
    connection.executemany(
        "INSERT INTO figure VALUES (?, ?, ?)",
        [(known[name], number, value) for name, value in row.quality.items()],
    )


def _insert(connection: sqlite3.Connection, table: str, values: Mapping[str, object]) -> int:
    names, places = ", ".join(values), ", ".join(f":{name}" for name in values)
    text = f"INSERT INTO {table} ({names}) VALUES ({places})"
    return connection.execute(text, values).lastrowid or 0


def write_remarks(
    connection: sqlite3.Connection,
    *,
    name: tuple[Kind, str],
    fingerprint: GroupFingerprint,
    review: schemas.Review | None,
    clicks: schemas.EpisodeClicks | None,
) -> None:
    """Change what people say of an item, by kind and id; `relink` must follow."""
    found = connection.execute("SELECT row FROM item WHERE kind = ? AND id = ?", name).fetchone()
    if found is None:
        return
    connection.execute(
        "UPDATE item SET folder = ?, content = ?, remarks = ?, own_verdict = ?, "
        "earlier_verdict = ?, is_superseded = ?, is_dirty = 1 WHERE row = ?",
        (*fingerprint, *_verdicts(review).values(), *found),
    )
    connection.execute(
        "UPDATE body SET review = ?, clicks = ? WHERE row = ?",
        (_json(review), _json(clicks), *found),
    )
    connection.execute("DELETE FROM result WHERE row = ?", found)
    _insert_results(connection, found[0], () if review is None else review.superseded_by)


def _verdicts(review: schemas.Review | None) -> dict[str, object]:
    earlier = None if review is None else review.earlier
    return {
        "own_verdict": None if review is None else review.verdict,
        "earlier_verdict": None if earlier is None else earlier.verdict,
        "is_superseded": review is not None and bool(review.superseded_by),
    }


def _insert_results(connection: sqlite3.Connection, row: int, results: tuple[str, ...]) -> None:
    connection.executemany(
        "INSERT OR IGNORE INTO result VALUES (?, ?)", [(row, name) for name in results]
    )


def _json(remark: schemas.Review | schemas.EpisodeClicks | None) -> str | None:
    return None if remark is None else remark.model_dump_json()


def relink(connection: sqlite3.Connection) -> None:
    """Make derived columns of changed items, and of those that they change, fit again."""
    execute = connection.execute
    if execute("SELECT 1 FROM item WHERE is_dirty LIMIT 1").fetchone():
        for statement in (_STAND, _LINK_EPISODES, _MARK_RECORDINGS, _LINK_RECORDINGS, _JUDGE):
            execute(statement)
        execute("UPDATE grp SET is_stale = 1 WHERE number IN (SELECT grp FROM item WHERE is_dirty)")
        execute(f"UPDATE item SET weight = '{NO_WEIGHT}' WHERE is_dirty AND NOT is_compared")
    for (group,) in execute("SELECT number FROM grp WHERE is_stale").fetchall():
        _compare(connection, group)
    execute(_TAKES)
    execute(
        "DELETE FROM grp WHERE num_items = 0 AND NOT EXISTS "
        "(SELECT 1 FROM item WHERE item.grp = grp.number)"
    )


def _compare(connection: sqlite3.Connection, group: int) -> None:
    """Compare the items of a group with each other, and sort them by what is unusual."""
    rows = connection.execute(
        "SELECT row, figures, fixed, weight FROM item WHERE grp = ? AND is_compared = 1", (group,)
    ).fetchall()
    values = np.frombuffer(b"".join(row[1] for row in rows)).reshape(-1, len(FIGURES))
    spread = spread_of(values)
    scores = outlier_scores(values, spread).max(axis=1, initial=0.0)
    weights = np.maximum(scores, [row[2] for row in rows]).tolist()
    changed = [
        (key, row[0])
        for row, key in zip(rows, map(_weight_key, weights), strict=True)
        if key != row[3]
    ]
    connection.executemany("UPDATE item SET weight = ? WHERE row = ?", changed)
    # Those of takes: an item is its own, or its episode's.
    connection.executemany("UPDATE item SET take_weight = ? WHERE row = ?", changed)
    connection.executemany("UPDATE item SET take_weight = ? WHERE aligned = ?", changed)
    connection.execute(
        "UPDATE grp SET is_stale = 0, num_items = ?, spread = ? WHERE number = ?",
        (len(rows), spread.tobytes() if len(rows) >= MIN_ITEMS else None, group),
    )
