"""Stress of store and wire format: values must be bit-identical, or refused by name."""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.stress.cells import Check, StageCells
from dextouch.episodes import EpisodeStore
from dextouch.errors import PacketError
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor, decode_batch, encode_batch, pack, unpack

STAGE = StageCells("store")
_ODD = np.array(
    [np.nan, -np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1e-310, 1.7976931348623157e308]
)
_MAX_BYTES = 1 << 20


@STAGE.cell("clock", "stamps of 0, 2^62 and ± the last int64; stamps that go back")
def _clock(check: Check) -> None:
    stamps = np.array([0, 1, 2**62, 2**63 - 1], dtype=np.int64)
    batch = _batch_of(np.zeros((4, 3)), stamps)
    back = decode_batch(encode_batch(_STREAM, batch, number=0), _STREAM, number=0)
    check.equal("stamps over the wire", back.t_host_ns, stamps)
    for what, bad in (
        ("back", stamps[::-1].copy()),
        ("from last to first", np.array([2**63 - 1, -(2**63)])),
    ):
        broken = _batch_of(np.zeros((len(bad), 3)), bad)
        check.refused(f"stamps {what}", encode_batch, _STREAM, broken, number=0)


@STAGE.cell(
    "non_finite", "NaN of both signs, ±infinity, -0, 5e-324, 1e-310 and the largest float64"
)
def _non_finite(check: Check) -> None:
    _, arrays = unpack(pack({}, {"odd": _ODD}), max_bytes=_MAX_BYTES)
    check.equal("packed", arrays["odd"], _ODD)
    values = np.repeat(_ODD[:, None], 3, axis=1)
    batch = _batch_of(values)
    back = decode_batch(encode_batch(_STREAM, batch, number=3), _STREAM, number=3)
    check.equal("over the wire", back.values, values)
    check.equal("through the store", _stored([batch]), values)
    damaged = bytearray(encode_batch(_STREAM, batch, number=3))
    damaged[-1] ^= 1
    check.refused(
        "one bit flipped", decode_batch, bytes(damaged), _STREAM, kind=PacketError, number=3
    )


@STAGE.cell("touch", "counts of 0 and 65535 in 360 cells")
def _touch(check: Check) -> None:
    counts = np.zeros((4, 360), dtype=np.uint16)
    counts[1::2] = 65_535
    _, arrays = unpack(pack({}, {"counts": counts}), max_bytes=_MAX_BYTES)
    check.equal("counts", arrays["counts"], counts)


@STAGE.cell("ends", "batches of 0 and 1 samples, number -1; arrays without numbers")
def _ends(check: Check) -> None:
    check.refused("no sample", encode_batch, _STREAM, _batch_of(np.zeros((0, 3))), number=0)
    check.refused("number -1", encode_batch, _STREAM, _batch_of(np.zeros((1, 3))), number=-1)
    empty = np.zeros((0, 5), dtype=np.float32)
    _, arrays = unpack(pack({}, {"empty": empty}), max_bytes=_MAX_BYTES)
    check.equal("an array without numbers", arrays["empty"], empty)


@STAGE.cell("precision", "float16, complex and long double arrays; float32 in a float64 stream")
def _precision(check: Check) -> None:
    for kind in ("float16", "complex128", "longdouble"):
        check.refused(kind, pack, {}, {"x": np.zeros(3, dtype=kind)})
    single = _batch_of(np.zeros((2, 3), dtype=np.float32))
    check.refused("float32 as float64", encode_batch, _STREAM, single, number=0)
    big = 2**53 + 1
    fields, _ = unpack(pack({"seed": big, "least": -(2**63)}, {}), max_bytes=_MAX_BYTES)
    check.true("whole numbers past float64's", fields == {"seed": big, "least": -(2**63)})
    check.refused("2^64", pack, {"seed": 2**64}, {})


@STAGE.cell("long_run", "1008 samples appended in 63 batches")
def _long_run(check: Check) -> None:
    values = np.random.default_rng(0).normal(size=(1008, 3))
    stamps = np.arange(1008, dtype=np.int64) * 66_666_667
    parts = [_batch_of(values[k : k + 16], stamps[k : k + 16]) for k in range(0, 1008, 16)]
    check.equal("values read back", _stored(parts), values)


@STAGE.cell("batch", "64 samples in one batch and in 64")
def _batch(check: Check) -> None:
    values = np.random.default_rng(1).normal(size=(64, 3))
    stamps = np.arange(64, dtype=np.int64)
    parts = [_batch_of(values[k : k + 1], stamps[k : k + 1]) for k in range(64)]
    check.equal("values read back", _stored(parts), _stored([_batch_of(values, stamps)]))


STAGE.does_not_apply(
    rotations="poses are numbers here; see geometry",
    one_axis="no motion is estimated",
    device="bytes on a disk",
)
_STREAM = StreamDescriptor(
    name="force", kind="scalar", shape=(3,), dtype="float64", unit="N", nominal_rate_hz=15.0
)
_ATTRIBUTES = RecordingAttributes(
    recording_id="stress", task="stress", instruction="stress", domain="robot", station="stress"
)


def _batch_of(values: np.ndarray, t_host_ns: np.ndarray | None = None) -> SampleBatch:
    num = len(values)
    stamps = np.arange(num, dtype=np.int64) if t_host_ns is None else t_host_ns
    absent = np.full(num, -1, dtype=np.int64)
    return SampleBatch(stamps, absent, absent, values)


def _stored(batches: list[SampleBatch]) -> np.ndarray:
    """Values read back from a recording of these batches."""
    with tempfile.TemporaryDirectory() as folder:
        store = EpisodeStore(Path(folder))
        with store.writer(kind="recording", attributes=_ATTRIBUTES) as writer:
            writer.add_stream(_STREAM)
            for batch in batches:
                writer.append("force", values=batch.values, t_host_ns=batch.t_host_ns)
        return store.recording(_ATTRIBUTES.recording_id).read("force").values
