"""Motion and touch of two made-up hands, exchanged and frozen."""

from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from dextouch.hands import CHAINS, chain_indices, mean_hand_m
from dextouch.schemas import matrix_rows
from dextouch.streams import HandTraces, StreamDescriptor
from dextouch.tactile.layout import DEXTOUCH_V1, SIDES
from services.acquisition.health.streams import HandsCheck
from tests.unit.acquisition.health_blocks_made import block, judged

SEEDS = range(20)
RATE_HZ = 60


def hands(seed, *, seconds=40):
    """Fingers of both hands that tap in turn, in a random order, while the wrists move a bit."""
    rng, count = np.random.default_rng(seed), RATE_HZ * seconds
    t_s = np.arange(count) / RATE_HZ
    streams = {}
    turns = rng.permutation(np.tile(np.arange(10), seconds // 10 + 1))[:seconds]
    for number, side in enumerate(SIDES):
        keypoints = np.repeat(mean_hand_m(side)[None], count, axis=0)
        kpa = np.zeros((count, 320))
        for finger, chain in enumerate(CHAINS):
            taps = (turns[t_s.astype(int)] == 5 * number + finger) * np.sin(np.pi * (t_s % 1)) ** 2
            nodes = chain_indices(chain)
            # The tip comes nearer to where the finger begins.
            way = keypoints[0, nodes[0]] - keypoints[0, nodes[-1]]
            keypoints[:, nodes[-1]] += 0.4 * taps[:, None] * way
            kpa[:, 16 * finger : 16 * finger + 16] = 80 * np.clip(taps - 0.4, 0, 1)[:, None]
        keypoints += 5e-4 * rng.standard_normal(keypoints.shape)
        waves = gaussian_filter1d(rng.standard_normal((count, 6)), 40, axis=0)
        poses = np.zeros((count, 7))
        # A hand at rest: what it moves is as much as the noise.
        poses[:, :3] = 3e-4 * (waves[:, :3] / waves.std() + rng.standard_normal((count, 3)))
        poses[:, 4:] = 1e-3 * (waves[:, 3:] / waves.std() + rng.standard_normal((count, 3)))
        poses[:, 3] = 1
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        streams |= {f"keypoints_{side}": keypoints, f"wrist_{side}": poses, f"tactile_{side}": kpa}
    return streams


def found(streams):
    traces = HandTraces()
    for name, values in streams.items():
        t_ns = np.round(np.arange(len(values)) * (1e9 / RATE_HZ)).astype(np.int64)
        layout = DEXTOUCH_V1 if name.startswith("tactile") else None
        for rows in np.array_split(np.arange(len(values)), 7):
            traces.add(name, t_ns[rows], values[rows], layout)
    return {name: cause for name, (cause, _) in traces.found().items()}


def test_hands_as_they_are():
    for seed in SEEDS:
        assert found(hands(seed)) == {}
        assert found(hands(seed, seconds=10)) == {}


@pytest.mark.parametrize("noise_m", [1e-5, 1e-4, 2e-4])
def test_a_tracker_that_stands_still_while_its_fingers_move(noise_m):
    for seed in SEEDS:
        streams, rng = hands(seed, seconds=15), np.random.default_rng(seed)
        poses = streams["wrist_left"]
        poses[:] = poses[0] + noise_m * rng.standard_normal(poses.shape)
        assert found(streams) == {"wrist_left": "frozen"}
        # Filtered noise is not white.
        poses[:] = poses[0] + 2e-4 * gaussian_filter1d(poses - poses[0], 20, axis=0) / noise_m
        assert found(streams) == {"wrist_left": "frozen"}
        # Nobody knows whether a hand whose fingers rest is still.
        streams["keypoints_left"][:] = streams["keypoints_left"][0]
        assert "wrist_left" not in found(streams)


def test_wrists_that_are_not_single_poses_say_nothing():
    traces, t_ns = HandTraces(), np.arange(5)
    for shape in ((5, 2, 7), (5, 6), (5,)):
        traces.add("wrist_left", t_ns, np.zeros(shape))
    assert traces.found() == {}


def test_a_tracker_that_stands_still_half_turned():
    """Noise changes the sign of a quaternion whose w is zero."""
    for seed in SEEDS:
        streams, rng = hands(seed, seconds=15), np.random.default_rng(seed)
        poses = streams["wrist_left"]
        poses[:] = [0.1, 0.2, 1.0, 0.0, 1.0, 0.0, 0.0] + 1e-4 * rng.standard_normal(poses.shape)
        poses[::2, 3:] *= -1
        poses[0] = np.nan
        assert found(streams) == {"wrist_left": "frozen"}


def test_hands_with_other_nodes_say_nothing():
    streams = hands(0)
    for side in SIDES:
        streams[f"keypoints_{side}"] = streams[f"keypoints_{side}"][:, :21]
    assert found(streams) == {}


@pytest.mark.parametrize("noise_m", [1e-4, 3e-4, 2e-3])
@pytest.mark.parametrize("seconds", [5, 15, 30])
def test_a_living_wrist_at_rest_is_not_still(noise_m, seconds):
    for seed in SEEDS:
        streams, rng = hands(seed, seconds=seconds), np.random.default_rng(seed)
        poses = streams["wrist_left"]
        sway = np.cumsum(rng.standard_normal(poses.shape), axis=0)
        sway = 1e-4 * (sway - sway.mean(axis=0)) / sway.std(axis=0)
        noise = rng.standard_normal(poses.shape)
        poses[:] = poses[0] + (sway + noise_m * noise) * ([1.0] * 3 + [5.0] * 4)
        assert found(streams) == {}
        # It shakes so fast that half seconds are alike.
        turns = 8 * np.pi * np.arange(len(poses))[:, None] / RATE_HZ + np.arange(7)
        poses[:] = poses[0] + 0.03 * np.sin(turns) + 1e-5 * noise
        assert found(streams) == {}
        # It rests, rounded to millimetres.
        poses[:] = np.round(streams["wrist_right"] + 1e-4 * noise, 3)
        assert found(streams) == {}


@pytest.mark.parametrize("sway", [0.03, 0.1, 0.2])
def test_a_hand_that_rests_on_a_table_while_the_other_one_moves_in_the_air(sway):
    for seed, seconds in product(SEEDS[:5], (6, 12, 30)):
        streams = hands(seed, seconds=seconds)
        t_s = np.arange(RATE_HZ * seconds) / RATE_HZ
        for side in SIDES:
            streams[f"tactile_{side}"][:] = 0
            streams[f"keypoints_{side}"][:] = streams[f"keypoints_{side}"][0]
        # 4 N on 40 taxels of 30 mm2.
        force_n = 4 * (1 + sway * np.sin(0.8 * np.pi * t_s + seed))
        streams["tactile_left"][:, 280:] = (force_n / (40 * 30e-6) / 1e3)[:, None]
        streams["wrist_right"][:, 0] += 0.15 * np.sin(2 * t_s)
        assert found(streams) == {}
        # Nor does a glove without a partner say anything.
        one = {name: values for name, values in streams.items() if "right" not in name}
        assert found(one) == {}


@pytest.mark.parametrize("seconds", [20, 40, 80])
def test_exchanged_gloves(seconds):
    hits = 0
    for seed in SEEDS:
        streams = hands(seed, seconds=seconds)
        left, right = (streams[f"tactile_{side}"] for side in SIDES)
        hits += found(streams | {"tactile_left": right, "tactile_right": left}) == {
            "tactile_left": "swapped"
        }
    assert hits >= {20: 0, 40: 15, 80: 20}[seconds], hits


@pytest.mark.parametrize("seconds", [40, 80, 160])
def test_exchanged_pads_of_a_glove(seconds):
    hits = 0
    for seed in SEEDS:
        streams = hands(seed, seconds=seconds)
        one, other = np.random.default_rng(seed).permutation(5)[:2] * 16
        kpa = streams["tactile_right"]
        kpa[:, [*range(one, one + 16), *range(other, other + 16)]] = kpa[
            :, [*range(other, other + 16), *range(one, one + 16)]
        ]
        hits += found(streams) == {"tactile_right": "swapped"}
    assert hits >= {40: 4, 80: 18, 160: 20}[seconds], hits


def live(streams, matrices, unit="kPa"):
    """What the health of a station says, by stream."""
    check, judges, said = HandsCheck(matrices), {}, {}
    for name, values in streams.items():
        kind = {"k": "keypoints", "w": "pose", "t": "tactile"}[name[0]]
        judges[name] = check.of(
            StreamDescriptor(
                name=name,
                kind=kind,
                shape=values.shape[1:],
                dtype="float64",
                unit={"pose": "pose_m_wxyz", "keypoints": "m", "tactile": unit}[kind],
                nominal_rate_hz=RATE_HZ,
            )
        )
    for second, name in product(range(len(values) // RATE_HZ), streams):
        t_s = second + np.arange(RATE_HZ) / RATE_HZ
        part = streams[name][second * RATE_HZ : (second + 1) * RATE_HZ]
        evaluation = judged(judges[name], block(t_s, part), round(1e9 * t_s[-1]))
        said.update((name, finding.code) for finding in evaluation.findings)
    return said


def test_the_health_of_a_station_names_the_same():
    streams = hands(0, seconds=30)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(streams["wrist_right"].shape)
    streams["wrist_right"][:] = streams["wrist_right"][0] + noise
    assert live(streams, {}) == {"wrist_right": "frozen"}


def test_the_health_of_a_station_leaves_out_refused_taxels_and_knows_maps_of_cells():
    streams, matrices = hands(1, seconds=60), {}
    left, right = (streams[f"tactile_{side}"] for side in SIDES)
    for name, kpa in (("tactile_left", right), ("tactile_right", left)):
        # Gloves of another maker send 330 counts, the first ten of no taxel; the last is refused,
        # and hides everything with what it reads.
        matrices |= {
            f"{name}_cells": matrix_rows(np.arange(10.0, 330)[None]),
            f"{name}_tare_counts": matrix_rows(np.full((1, 330), 20.0)),
            f"{name}_gain_counts_per_kpa": matrix_rows(np.array([[4.0] * 329 + [0.0]])),
            f"{name}_taxel_state": matrix_rows(np.array([[0.0] * 329 + [1.0]])),
        }
        streams[name] = 20 + 4 * np.pad(kpa, ((0, 0), (10, 0)))
        streams[name][:, -1] = np.random.default_rng(0).uniform(0, 4e6, len(kpa))
    assert live(streams, matrices, "counts") == {"tactile_left": "implausible"}
