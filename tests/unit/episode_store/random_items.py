"""Random items of a store: attributes and commit records alone, as no list opens an array."""

import shutil
from datetime import UTC, datetime, timedelta

from dextouch.episodes.format import (
    ATTRIBUTES,
    CommitRecord,
    encode_commit,
    group_metadata,
    sha256_hex,
    stream_arrays,
    with_rows,
)
from dextouch.schemas import Review
from dextouch.streams import StreamDescriptor
from tests.unit.episode_store.episodes import IDENTITY_ROWS, POSES

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
ACTION = StreamDescriptor(
    name="action",
    kind="robot_state",
    shape=(67,),
    dtype="float64",
    unit="action_m_rad",
    nominal_rate_hz=15,
)
QUALITY = ("coverage", "static_share", "head_num_gaps", "wrist_left_peak_speed_m_s", "other")


def put_item(store, kind, name, *, num_rows=9, **changes):
    """Put an item into a store, in the place of an earlier one."""
    fields = {f"{kind}_id": name, "task": "stack", "instruction": "do it", "domain": "robot"}
    if kind == "episode":
        fields |= {"origin": "twin", "anchor": dict.fromkeys(POSES, IDENTITY_ROWS)}
        fields |= {"K_head": [[60, 0, 16], [0, 60, 16], [0, 0, 1]]}
    else:
        fields["station"] = "bench"
    about = ATTRIBUTES[kind].model_validate(fields | {"streams": [ACTION]} | changes)
    group = group_metadata(about.model_dump(mode="json"))
    record = CommitRecord(
        kind=kind,
        id=name,
        attributes_sha256=sha256_hex(group),
        arrays={n: with_rows(one, num_rows) for n, one in stream_arrays(ACTION, kind).items()},
    )
    stage, target = store.root / ".staging" / name, store.root / f"{kind}s" / name
    stage.mkdir(parents=True)
    (stage / "zarr.json").write_bytes(group)
    (stage / "commit.json").write_bytes(encode_commit(record)[0])
    target.parent.mkdir(exist_ok=True)
    shutil.rmtree(target, ignore_errors=True)
    stage.rename(target)


def put_random(store, rng, names):
    """Put an item of one of these names, episodes of others among them, with random facts."""
    kind = str(rng.choice(["recording", "episode"]))

    def one_of(*values):
        return values[rng.integers(len(values))]

    def sources():
        for _ in range(rng.integers(3)):
            kind, name, sha256 = one_of("recording", "episode"), one_of(*names), None
            if rng.random() < 0.5:
                # Of the item as it is stored, or of another one with its id.
                is_stored = store.exists(name, kind=kind) and rng.random() < 0.8
                sha256 = store.open_item(kind, name).content_sha256 if is_stored else "0" * 64
            yield {"kind": kind, "id": name, "sha256": sha256}

    at = None if rng.random() < 0.2 else NOON + timedelta(minutes=int(rng.integers(-3000, 3000)))
    quality = {name: float(rng.normal() ** 5) for name in QUALITY if rng.random() < 0.7}
    changes = {
        "task": one_of("a", "a", "a", "b"),
        "instruction": one_of("Stand it", "straße", "do it"),
        "operator": one_of(None, "ada", "bo"),
        "station": one_of("bench", "desk"),
        "success": one_of(None, "yes", "yes", "no"),
        "recovered": bool(rng.random() < 0.2),
        "trace_id": one_of(None, "0123456789abcdef" * 2),
        "lineage": list(sources()),
        "quality": quality,
        "complete": bool(rng.random() < 0.8),
    }
    if kind == "recording":
        changes |= {"started_at": at, "consent": bool(rng.integers(2))}
        changes["domain"] = "human"
    else:
        warnings = one_of((), (), ["skew"])
        changes |= {"created_at": at, "origin": one_of(*["recorded"] * 4, "twin", "imagined")}
        clock = {"stream": "action", "num_samples": 9, "num_dropped": int(rng.integers(5))}
        clock |= {"residual_rms_ms": float(rng.gamma(1.0)), "warnings": warnings}
        changes["clocks"] = one_of((), [clock])
    name = one_of(*names)
    put_item(store, kind, name, num_rows=int(rng.integers(1, 40) ** 2), **changes)
    return kind, name


def review_random(store, rng, kind, name):
    """A random review, or none."""
    verdict = [None, "accepted", "accepted", "rejected"][rng.integers(4)]
    review = verdict and Review(verdict=verdict, reviewer="ada", reviewed_at=NOON)
    if rng.random() < 0.4:
        # Of an edit, whose results are stored, or not any more.
        stored = rng.permutation(store.list(kind=kind))[:1] if rng.random() < 0.5 else ()
        review = Review(
            verdict="rejected",
            reviewed_at=NOON,
            superseded_by=(*map(str, stored), "gone"),
            earlier=review,
        )
    store.set_review(name, review, kind=kind)
