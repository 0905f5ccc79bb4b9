"""The catalog in plain Python, over all items at once: what queries of the real one must find."""

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np

from dextouch.schemas import Finding
from services.episode_store.catalog_rows import _episode, _recording
from services.episode_store.filters import quality_bound
from services.episode_store.items import FIGURES, MAX_SCORE, MIN_ITEMS, item_of

WEIGHTS = {
    "incomplete": 20.0,
    "beyond_limit": 15.0,
    "doubtful_clock": 10.0,
    "recovered": 5.0,
    "not_judged": 1.0,
}
COMPARED = ("task", "operator", "station", "domain", "success", "recovered", "origin", "trace_id")
LATEST = datetime(9999, 12, 31, tzinfo=UTC)


@dataclass(frozen=True)
class Entry:
    """An item with what it is filtered by."""

    item: object
    summary: object
    quality: dict
    lineage: tuple
    text: str

    def having(self, **changes):
        """With changes of the item."""
        return replace(self, item=self.item.model_copy(update=changes))


def read_all(store, kind):
    """Entries by id."""
    return {name: _entry(store, kind, name) for name in store.list(kind=kind)}


def _entry(store, kind, name):
    reader = store.open(name) if kind == "episode" else store.recording(name)
    summary = _episode(reader) if kind == "episode" else _recording(store, reader)
    about = reader.attributes
    parts = name, about.task, about.instruction, about.operator, about.station, about.trace_id
    return Entry(
        item=item_of(reader, summary).model_copy(update={"review": store.review(name, kind=kind)}),
        summary=summary,
        quality=dict(about.quality),
        lineage=about.lineage,
        text="\n".join(part or "" for part in parts).casefold(),
    )


def listed(recordings, episodes):
    """Linked entries by the kind of list and by `ID/KIND`, with the findings of all."""
    theirs = {name: _linked(one, recordings, episodes) for name, one in episodes.items()}
    made = defaultdict(list)
    ours = {n: one.having(review=_standing(one, recordings)) for n, one in recordings.items()}
    for name, entry in theirs.items():
        for source in entry.item.recordings if entry.item.origin != "imagined" else ():
            made[source].append(name)
    for name, products in made.items():
        ours[name] = ours[name].having(episodes=tuple(products))
    found = _findings([*theirs.values(), *(one for one in ours.values() if not one.item.episodes)])
    theirs, ours = (
        {n: one.having(findings=found.get((n, one.item.kind), ())) for n, one in entries.items()}
        for entries in (theirs, ours)
    )
    takes = {f"{name},recording": _take(one, theirs) for name, one in ours.items()}
    takes |= {
        f"{name},episode": one
        for name, one in theirs.items()
        if one.item.origin == "imagined" or not one.item.recordings
    }
    return {
        "recording": {f"{name},recording": one for name, one in ours.items()},
        "episode": {f"{name},episode": one for name, one in theirs.items()},
        "take": takes,
    }


def _standing(entry, stored):
    review = entry.item.review
    return review and review.standing(lambda name: name in stored)


def _linked(entry, recordings, episodes):
    names = _stored(entry, "recording", recordings)
    sources = [recordings[name].item for name in names]
    torn = next((one for one in (entry.item, *sources) if not one.complete), entry.item)
    review = _standing(entry, episodes)
    if review is None:
        above = _stored(entry, "episode", episodes)
        reviews = [one.review for one in (*sources, *(episodes[name].item for name in above))]
        review = next((one for one in reviews if one and _rejects_products(one)), None)
    return entry.having(
        recordings=tuple(names),
        consent=all(one.consent for one in sources) if names else None,
        review=review,
        complete=torn.complete,
        incomplete_cause=torn.incomplete_cause,
    )


def _stored(entry, kind, stored):
    return [
        one.id
        for one in entry.lineage
        if one.kind == kind and one.id in stored
        if one.sha256 in {None, stored[one.id].summary.content_sha256}
    ]


def _rejects_products(review):
    if review.superseded_by:
        return review.earlier is not None and review.earlier.verdict == "rejected"
    return review.verdict == "rejected"


def _take(recording, episodes):
    if not recording.item.episodes:
        return recording
    aligned = episodes[recording.item.episodes[-1]]
    item = aligned.item
    take = recording.having(
        aligned=item,
        figures=item.figures,
        time_doubts=item.time_doubts,
        findings=item.findings,
        review=item.review or recording.item.review,
    )
    quality = recording.quality | aligned.quality
    return replace(take, quality=quality, text=f"{recording.text}\n{aligned.text}")


def _findings(entries):
    groups, found = defaultdict(list), {}
    for item in (entry.item for entry in entries):
        if item.review is None or item.review.verdict != "rejected":
            groups[item.task, item.domain, item.origin, item.kind].append(item)
    for items in groups.values():
        for item in items:
            own = [*item.findings, *_outliers(item, items)]
            if not item.complete:
                text = f"incomplete: {item.incomplete_cause or 'no cause noted'}"
                own.insert(0, Finding(code="incomplete", message=text))
            if item.time_doubts:
                text = f"times in doubt: {', '.join(item.time_doubts)}"
                own.append(Finding(code="doubtful_clock", message=text))
            if item.recovered:
                text = "cut short: the program that wrote it ended before the take did"
                own.append(Finding(code="recovered", message=text))
            if item.success is None and item.origin == "recorded":
                own.append(Finding(code="not_judged", message="outcome not judged"))
            found[item.id, item.kind] = tuple(own)
    return found


def _outliers(item, items):
    for figure in FIGURES:
        values = [one.figures[figure.name] for one in items if figure.name in one.figures]
        if len(values) < MIN_ITEMS or figure.name not in item.figures:
            continue
        value, median = item.figures[figure.name], float(np.median(values))
        sigma = float(np.median(np.abs(np.array(values) - median))) / 0.6745
        score = (value - median) / max(sigma, figure.resolution)
        if {"both": abs(score), "high": score, "low": -score}[figure.bad] > MAX_SCORE:
            text = f"{figure.label} {figure.text(value)}, usually {figure.text(median)}"
            facts = {"figure": figure.name, "value": value, "median": median, "score": score}
            yield Finding(code="outlier", message=text, **facts)


def matches(entry, query):
    """Whether an entry matches all filters of a query."""
    item = entry.item
    for name in COMPARED:
        wanted = getattr(query, name, None)
        if wanted is not None and getattr(item, name) != wanted:
            return False
    after = query.created_after or datetime(1, 1, 1, tzinfo=UTC)
    in_time = after <= (item.at or LATEST) < (query.created_before or LATEST)
    verdict = item.review.verdict if item.review else "not_reviewed"
    derived, review = getattr(query, "derived_from", None), getattr(query, "review", None)
    flagged, ids = getattr(query, "flagged", None), getattr(query, "id", ())
    bounds = [quality_bound(text) for text in query.min_quality]
    outcomes = {"success": True, "failure": False, "not_judged": None}
    return (
        all(entry.quality.get(name, -math.inf) >= least for name, least in bounds)
        and (query.outcome is None or item.success is outcomes[query.outcome])
        and (not query.text or query.text.casefold() in entry.text)
        and ((query.created_after or query.created_before) is None or in_time)
        and (derived is None or any(one.id == derived for one in entry.lineage))
        and (review is None or review == verdict)
        and (flagged is None or flagged == bool(item.findings))
        and (not ids or item.id in ids)
    )


def key_of(item, sort):
    """Text by which an item is sorted, its name apart."""
    if sort == "id":
        return ""
    if sort == "duration":
        return f"{item.duration_s:020.6f}"
    if sort == "findings":
        scores = (abs(one.score or WEIGHTS.get(one.code, 0.0)) for one in item.findings)
        return f"{max(scores, default=0.0):020.6f}"
    if sort == "time":
        at = item.at
        return "" if at is None else at.astimezone(UTC).isoformat(timespec="microseconds")
    return getattr(item, sort) or ""


def in_order(entries, query, page):
    """Names and entries of all rows that match, in the order of a page."""
    found = [
        (key_of(one.item, page.sort), n, one) for n, one in entries.items() if matches(one, query)
    ]
    return sorted(found, key=lambda row: row[:2], reverse=page.descending)


def hours_by(entries, field, utc_offset_min):
    """Hours by values and verdicts."""
    zone = timezone(timedelta(minutes=utc_offset_min))
    sums = defaultdict(lambda: defaultdict(float))
    for item in (entry.item for entry in entries):
        value = getattr(item, field, None)
        if field == "day":
            value = None if item.at is None else item.at.astimezone(zone).date().isoformat()
        sums[value][item.review.verdict if item.review else "not_reviewed"] += item.duration_s
    return {value: dict(verdicts) for value, verdicts in sums.items()}
