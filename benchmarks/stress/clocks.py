"""Stress of clocks: counter wraps in gaps, steps, huge stamps, long takes."""

import numpy as np

from benchmarks.stress.cells import Check, StageCells
from dextouch.clocks import OnlineClock, count_lost_samples, fit_clock, unwrap_counter
from dextouch.errors import ClockFitError, ShapeError
from dextouch.streams import ClockCapabilities, StreamDescriptor

STAGE = StageCells("clocks")
_PERIOD_NS = 16_666_667
# Silence of the device as a share of the counter's period.
_PAUSES = (0.3, 0.5, 0.9, 1.0, 1.5, 3.7, 1000.25)


@STAGE.cell("clock", "16- and 32-bit counters silent for 0.3 … 1000 wraps; a clock that is stepped")
def _clock(check: Check) -> None:
    worst = {"stamps offline": 0, "stamps online": 0}
    for bits, tick_ns in ((16, 1_000), (32, 1_000)):
        turn_ns = 2**bits * tick_ns
        for share in _PAUSES:
            device_ns = np.arange(40, dtype=np.int64) * _PERIOD_NS
            device_ns[20:] += round(share * turn_ns)
            device_ns -= device_ns % tick_ns
            host_ns = device_ns + 5_000_000 + 300_000 * (np.arange(40) % 3)
            counts = device_ns // tick_ns % 2**bits
            straight = unwrap_counter(counts, modulus=2**bits, hint=host_ns // tick_ns) * tick_ns
            worst["stamps offline"] = max(worst["stamps offline"], _off(straight, device_ns))
            late = _live(counts * tick_ns, host_ns, _descriptor(bits, tick_ns)) - device_ns
            worst["stamps online"] = max(worst["stamps online"], _off(late, late * 0 + 5_000_000))
    for what, bound in (("stamps offline", 0), ("stamps online", 700_000)):
        check.at_most(f"{what} off after a pause", worst[what], bound, "ns")
    num_lost = count_lost_samples(np.array([65534, 65535, 0, 3]), bits=16)
    check.true("a wrap of numbers is no loss, 2 lost after it", num_lost == 2)
    device, host = _take(3000, 20.0)
    stepped = device.copy()
    stepped[1500:] += 3_000_000_000
    model = fit_clock(stepped, host)
    check.true("a step of 3 s found once", model.num_steps == 1)
    off_ns = np.abs(model.to_host_ns(stepped, host) - _truth(device, 20.0)).max()
    check.at_most("dates beside the step off", off_ns, 200_000, "ns")
    back = device.copy()
    back[1500:] -= 10_000_000_000
    model = fit_clock(back, host)
    check.true("a step back is found and ambiguous", model.num_steps == 1 and model.is_ambiguous)
    check.refused("dates without arrivals", model.to_host_ns, back)


@STAGE.cell(
    "non_finite", "float stamps with NaN; counts outside the counter; arrivals that go back"
)
def _non_finite(check: Check) -> None:
    device, host = _take(100, 0.0)
    broken = device.astype(np.float64)
    broken[50] = np.nan
    check.refused("NaN stamps", fit_clock, broken, host, kind=ClockFitError)
    check.refused("NaN counts", unwrap_counter, broken, kind=ShapeError, modulus=2**32)
    check.refused("count past the modulus", unwrap_counter, np.array([70_000]), modulus=2**16)
    check.refused("arrivals go back", fit_clock, device, host[::-1], kind=ClockFitError)
    check.refused("a clock that stands", fit_clock, device * 0, host, kind=ClockFitError)
    clock = OnlineClock(None)
    clock.update(t_host_ns=0, t_device_ns=0)
    check.refused("a stamp that is missing", clock.update, t_host_ns=1)


@STAGE.cell("ends", "10 samples, the fewest; dates before the first and after the last sample")
def _ends(check: Check) -> None:
    device, host = _take(10, 0.0)
    model = fit_clock(device, host)
    outside = np.array([device[0] - 10**9, device[-1] + 10**9])
    off_ns = np.abs(model.to_host_ns(outside) - outside - 1_000_000).max()
    check.at_most("dates a second outside off", off_ns, 700_000, "ns")
    check.refused("9 samples", fit_clock, device[:9], host[:9], kind=ClockFitError)
    check.refused("no sample", fit_clock, device[:0], host[:0], kind=ClockFitError)


@STAGE.cell("precision", "stamps near 2^62 ns, where float64 knows only every 512th nanosecond")
def _precision(check: Check) -> None:
    device, host = _take(2000, 35.0)
    shift = 2**62 + 12_345
    near, far = fit_clock(device, host), fit_clock(device + shift, host + shift)
    difference = far.to_host_ns(device + shift) - shift - near.to_host_ns(device)
    check.at_most("dates change by", np.abs(difference).max(), 0, "ns")
    live = _live(device[:500], host[:500])
    moved = _live(device[:500] + shift, host[:500] + shift) - shift - live
    check.at_most("live dates change by", np.abs(moved).max(), 0, "ns")


@STAGE.cell("long_run", "60 000 samples (1000 s), 30 ppm fast, live and offline")
def _long_run(check: Check) -> None:
    device, host = _take(60_000, 30.0)
    true_ns = _truth(device, 30.0)
    off_ns = np.abs(fit_clock(device, host).to_host_ns(device) - true_ns)
    check.at_most("offline off", off_ns.max(), 50_000, "ns")
    live = _live(device[::6], host[::6])
    late = np.abs(live - true_ns[::6])[600:]
    check.at_most("live off after a minute", late.max(), 200_000, "ns")
    check.true("live dates rise", (np.diff(live) > 0).all())


@STAGE.cell("batch", "dates of 2000 stamps at once and one by one")
def _batch(check: Check) -> None:
    device, host = _take(2000, -50.0)
    model = fit_clock(device, host)
    alone = np.concatenate([model.to_host_ns(device[k : k + 1]) for k in range(len(device))])
    check.equal("dates", model.to_host_ns(device), alone)


STAGE.does_not_apply(
    rotations="no rotations",
    one_axis="no motion",
    touch="no touch",
    device="whole numbers in the host's memory",
)


def _take(num_samples: int, skew_ppm: float) -> tuple[np.ndarray, np.ndarray]:
    """Device timestamps at 60 Hz and their arrivals, 1 ms or slightly more later."""
    device = np.arange(num_samples, dtype=np.int64) * _PERIOD_NS
    delay_ns = np.random.default_rng(num_samples).exponential(300_000, num_samples)
    delay_ns[::7] = 0.0
    host = _truth(device, skew_ppm) + delay_ns.astype(np.int64)
    return device, np.maximum.accumulate(host)


def _truth(device: np.ndarray, skew_ppm: float) -> np.ndarray:
    """Arrival times without any delay."""
    return np.rint(device * (1 + skew_ppm * 1e-6)).astype(np.int64) + 1_000_000


def _live(
    device_ns: np.ndarray, host_ns: np.ndarray, descriptor: StreamDescriptor | None = None
) -> np.ndarray:
    """Dates by the online clock, sample by sample."""
    clock = OnlineClock(descriptor)
    pairs = zip(device_ns.tolist(), host_ns.tolist(), strict=True)
    return np.array([clock.update(t_host_ns=h, t_device_ns=d) for d, h in pairs])


def _descriptor(bits: int, tick_ns: int) -> StreamDescriptor:
    return StreamDescriptor(
        name="stress",
        kind="scalar",
        shape=(1,),
        dtype="float32",
        unit="N",
        nominal_rate_hz=60.0,
        capabilities=ClockCapabilities(device_time=True, device_time_bits=bits, tick_ns=tick_ns),
    )


def _off(got: np.ndarray, expected: np.ndarray) -> int:
    """Largest difference, with both series relative to their first value."""
    return int(np.abs((got - got[0]) - (expected - expected[0])).max())
