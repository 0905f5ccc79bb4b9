"""Truth → mock devices → bytes → drivers → spool: nothing changes but what the faults did."""

import numpy as np
import pytest

from dextouch.clocks import fit_clock
from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import TakePrompt
from dextouch.tactile.layout import select_taxels
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.mock_station import LEDGER_FILE, MockStation
from services.acquisition.mocks.faults import DeviceFaults, Fate, FaultScript
from services.acquisition.settings import MockLinks
from tests.integration.recording_streams import human_streams, robot_streams
from tests.unit.acquisition.ledgers import load, true_times_ns

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
HARD = DeviceFaults(
    skew_ppm=-80, path_delay_ms=3.0, jitter_ms=2.0, drop_probability=0.03, bit_error_rate=4e-6
)


def record(streams, faults, tmp_path, *, seed=1, clock=None, **options):
    clock = clock or VirtualClock()
    station = MockStation(streams, faults, seed, clock, spool_root=tmp_path, **options)
    with station:
        take = station.run_take(PROMPT, recording_id="take")
        devices = {device.device: device for device in station.station.health.report().devices}
    return take, SpoolReader(take.spool_path), devices


def truth(streams):
    return {s.descriptor.name: s for s in streams}


def pressures(spool, side):
    record = spool.attributes.calibration
    tare = np.array(record[f"tactile_{side}_tare_counts"])
    gain = np.array(record[f"tactile_{side}_gain_counts_per_kpa"])
    assert tare.shape == gain.shape == (1, 360)
    return select_taxels((spool.read(f"tactile_{side}").values - tare) / gain, side=side)


@pytest.mark.parametrize(
    "streams", [human_streams(0.7), robot_streams(0.7)], ids=["human", "robot"]
)
def test_a_perfect_station_changes_nothing(streams, tmp_path):
    take, spool, _ = record(streams, FaultScript(), tmp_path)
    assert take.check.complete
    assert take.check.problems == ()
    assert set(spool.streams) == set(truth(streams))
    for name, stream in truth(streams).items():
        batch = spool.read(name)
        np.testing.assert_array_equal(batch.sequence, np.arange(len(stream.t_ns)))
        np.testing.assert_array_equal(batch.t_host_ns, take.ledger.start_host_ns + stream.t_ns)
        np.testing.assert_array_equal(np.diff(batch.t_device_ns), np.diff(stream.t_ns))
        if stream.descriptor.kind == "tactile":
            error_kpa = np.abs(pressures(spool, stream.descriptor.name[8:]) - stream.values)
            assert error_kpa.max() <= 0.5 / 38
        else:
            np.testing.assert_allclose(batch.values, stream.values, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "streams", [human_streams(1.5), robot_streams(1.5)], ids=["human", "robot"]
)
def test_counters_equal_the_ledger(streams, tmp_path):
    take, spool, devices = record(streams, FaultScript(others=HARD), tmp_path)
    assert set(devices) == set(take.ledger.devices)
    damaged = 0
    for name, ledger in take.ledger.devices.items():
        assert devices[name].lost == ledger.count_lost_between() > 0
        assert devices[name].packets == ledger.count(Fate.SENT)
        assert devices[name].reconnects == 0
        damaged += ledger.count(Fate.CORRUPTED)
        if not ledger.count(Fate.CORRUPTED):
            assert devices[name].crc_errors == devices[name].resync_bytes == 0
    assert damaged > 0
    for name, descriptor in spool.streams.items():
        batch = spool.read(name)
        ledger = take.ledger.of(descriptor.device)
        sent = [s for s, fate in zip(ledger.sequence, ledger.fate, strict=True) if fate == "sent"]
        assert batch.sequence.tolist() == sent
        entries = {e.event: e.count for e in spool.attributes.ledger if e.stream == name}
        assert entries["lost"] == ledger.count_lost_between()


def test_ledger_tells_the_truth_about_time(tmp_path):
    faults = FaultScript(others=HARD.model_copy(update={"bit_error_rate": 0.0}))
    take, spool, _ = record(human_streams(2.0), faults, tmp_path)
    assert load(take.spool_path / LEDGER_FILE) == take.ledger
    for name, descriptor in spool.streams.items():
        batch, ledger = spool.read(name), take.ledger.of(descriptor.device)
        late_ns = batch.t_host_ns - true_times_ns(ledger, batch.sequence)
        assert late_ns.min() >= 3_000_000
        assert np.all(np.diff(batch.t_host_ns) >= 0)
        model = fit_clock(batch.t_device_ns, batch.t_host_ns)
        times_ns = model.to_host_ns(batch.t_device_ns, batch.t_host_ns)
        error_ns = times_ns - true_times_ns(ledger, batch.sequence) - ledger.path_delay_ns
        assert np.sqrt(np.mean(error_ns**2.0)) < 1e6, name
        latency_ns = spool.attributes.calibration[f"{name}_latency_ns"][0][0]
        assert latency_ns == pytest.approx(ledger.path_delay_ns, abs=1e6)


def test_same_seed_same_take(tmp_path):
    takes = [
        record(human_streams(0.5), FaultScript.first_light(), tmp_path / str(i), seed=s)
        for i, s in enumerate((3, 3, 4))
    ]
    (first, one, _), (second, two, _), (other, _, _) = takes
    assert first.ledger == second.ledger != other.ledger
    for name in one.streams:
        a, b = one.read(name), two.read(name)
        for field in ("t_host_ns", "t_device_ns", "sequence", "values"):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


def test_noise_is_as_strong_as_asked(tmp_path):
    streams = [s for s in human_streams(4.0) if s.descriptor.name.endswith("s_left")]
    streams += [s for s in human_streams(4.0) if s.descriptor.name == "wrist_left"]
    _, spool, _ = record(streams, FaultScript.first_light(), tmp_path)
    for name, axes in (("wrist_left", slice(0, 3)), ("keypoints_left", slice(None))):
        batch = spool.read(name)
        noise_m = (batch.values - truth(streams)[name].values[batch.sequence])[:, axes]
        assert noise_m.std() == pytest.approx(5e-4, rel=0.1)
    batch = spool.read("wrist_left")
    dots = np.sum(batch.values[:, 3:] * truth(streams)["wrist_left"].values[batch.sequence, 3:], 1)
    turn_deg = np.rad2deg(2 * np.arccos(np.minimum(1, np.abs(dots))))
    assert np.sqrt(np.mean(turn_deg**2)) == pytest.approx(0.05 * np.sqrt(3), rel=0.1)


@pytest.mark.parametrize("device", ["glove_left", "finger_tracker_left", "camera_head"])
def test_unplugged_device_comes_back(device, tmp_path):
    faults = FaultScript(devices={device: DeviceFaults(unplugged_s=((0.3, 0.9),))})
    take, spool, devices = record(human_streams(1.4), faults, tmp_path)
    assert not take.check.complete
    assert {p.stream for p in take.check.problems} == {
        name for name, d in spool.streams.items() if d.device == device
    }
    assert devices[device].reconnects == 1
    assert all(d.reconnects == 0 for name, d in devices.items() if name != device)
    ledger = take.ledger.of(device)
    assert devices[device].lost == ledger.count(Fate.UNPLUGGED) > 0
    (name,) = [name for name, d in spool.streams.items() if d.device == device]
    gap_ns = np.diff(spool.read(name).t_host_ns).max()
    assert 0.6e9 <= gap_ns <= 0.6e9 + 0.3e9
    assert spool.read(name).sequence[-1] == len(ledger.sequence) - 1


def test_clock_step_is_in_the_device_stamps(tmp_path):
    step = DeviceFaults(clock_step_at_s=0.5, clock_step_s=0.2)
    _, spool, _ = record(human_streams(0.8), FaultScript(devices={"glove_left": step}), tmp_path)
    assert np.diff(spool.read("tactile_left").t_device_ns).max() == pytest.approx(
        216_666_667, abs=2
    )
    assert np.diff(spool.read("tactile_right").t_device_ns).max() < 17_000_000


def test_dead_taxels_read_zero(tmp_path):
    faults = FaultScript(devices={"glove_left": DeviceFaults(dead_taxels=(3, 200))})
    _, spool, _ = record(human_streams(0.5), faults, tmp_path)
    dead = np.flatnonzero((spool.read("tactile_left").values == 0).all(axis=0))
    assert dead.tolist() == [3, 200]


def test_jpeg_cameras_stay_compressed(tmp_path):
    _, spool, _ = record(
        human_streams(0.5), FaultScript(), tmp_path, links=MockLinks(images="jpeg")
    )
    assert spool.streams["camera_head"].unit == "jpeg"
    assert spool.read("camera_head").values[0][:2] == b"\xff\xd8"


def test_real_time_on_a_pty(tmp_path):
    streams = [s for s in human_streams(0.5) if s.descriptor.name == "tactile_left"]
    take, spool, _ = record(streams, FaultScript(), tmp_path, clock=StationClock())
    batch = spool.read("tactile_left")
    np.testing.assert_array_equal(batch.sequence, np.arange(30))
    late_ns = batch.t_host_ns - true_times_ns(take.ledger.of("glove_left"), batch.sequence)
    assert late_ns.min() >= 0
    # How late depends on the machine's other work; a stamp of another clock is off by far more.
    assert np.median(late_ns) < 500_000_000


def test_takes_of_one_station_share_the_devices_clocks(tmp_path):
    faults = FaultScript(others=DeviceFaults(skew_ppm=100.0))
    streams = [s for s in human_streams(0.5) if s.descriptor.name == "tactile_left"]
    with MockStation(streams, faults, 1, VirtualClock(), spool_root=tmp_path) as station:
        takes = [station.run_take(PROMPT, recording_id=name) for name in ("a", "b")]
    first, second = (SpoolReader(take.spool_path).read("tactile_left") for take in takes)
    assert second.sequence[0] == first.sequence[-1] + 1
    elapsed_host_ns = second.t_host_ns[-1] - first.t_host_ns[0]
    elapsed_device_ns = second.t_device_ns[-1] - first.t_device_ns[0]
    assert elapsed_device_ns == pytest.approx(elapsed_host_ns * 1.0001, abs=2)
    for take, batch in zip(takes, (first, second), strict=True):
        true_ns = true_times_ns(take.ledger.of("glove_left"), batch.sequence)
        np.testing.assert_array_equal(batch.t_host_ns, true_ns)
        assert true_ns[0] == take.ledger.start_host_ns
