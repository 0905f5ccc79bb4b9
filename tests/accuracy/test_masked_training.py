"""World models of takes with gaps and dead taxels: masks against silent interpolation and zeros."""

import json
import subprocess
import sys

import numpy as np
import pytest

from dextouch.episodes import EpisodeGrid, EpisodeStore
from dextouch.schemas import matrix_rows
from dextouch.tactile.layout import NUM_TAXELS, SIDES

SEEDS = (0, 1, 2)
TASKS = "stand_bottle,stack_bowls"
TAKES, HELDOUT = 40, 12
# Of the taxels of every take, as many as a glove that is worn out; alignment accepts up to half.
DEAD_SHARE = 0.3
GAP_STEPS, GAP_EVERY = 4, 16
STEPS = (
    "--num-members 1 --jobs 1 --reader.num-steps 150 --core.num-steps 500 "
    "--drawing.max-steps 2 --core.batch 32"
)
METRICS = "tactile_mse,contact_f1,object_error"


def run(line):
    subprocess.run([sys.executable, "-m", "services.cli.main", *line.split()], check=True)


def damage(source, masked, silent):
    """Copies of takes with interpolated actions and dead taxels, with and without masks."""
    for number, name in enumerate(source.list()):
        reader = source.open(name)
        rng = np.random.default_rng(number)
        grid = EpisodeGrid(reader)
        dead = {side: rng.random(NUM_TAXELS) < DEAD_SHARE for side in SIDES}
        starts = np.arange(GAP_EVERY, len(grid) - GAP_STEPS - 1, GAP_EVERY)
        rows = [(grid.t_ref_ns[s] / 1e9, grid.t_ref_ns[s + GAP_STEPS] / 1e9) for s in starts]
        known = {"interpolated_joints_measured_s": matrix_rows(np.array(rows))}
        for side in SIDES:
            states = dead[side].astype(float)
            known[f"tactile_{side}_refused_taxels"] = matrix_rows(states[None])
        for store, matrices in ((masked, known), (silent, {})):
            about = reader.attributes
            about = about.model_copy(
                update={"streams": (), "calibration": about.calibration | matrices}
            )
            with store.writer(kind="episode", attributes=about) as writer:
                for stream in reader.attributes.streams:
                    data = reader.read(stream.name)
                    values = data.values.copy()
                    if stream.name.startswith("tactile"):
                        values[:, dead[stream.name.removeprefix("tactile_")]] = 0.0
                    if stream.name.startswith("action"):
                        for first in starts:
                            ends = values[first - 1], values[first + GAP_STEPS]
                            shares = np.arange(1, GAP_STEPS + 1)[:, None] / (GAP_STEPS + 1)
                            values[first : first + GAP_STEPS] = (
                                ends[0] * (1 - shares) + ends[1] * shares
                            )
                    writer.add_stream(stream)
                    writer.append(stream.name, values=values, t_ref_ns=data.t_ref_ns)


@pytest.mark.slow
def test_masks_beat_silence_with_every_seed(tmp_path):
    run(
        f"train data --store {tmp_path}/whole --tasks {TASKS} --images 4 --count {TAKES} "
        "--mix demonstrations --jobs 1"
    )
    run(
        f"train data --store {tmp_path}/heldout --tasks {TASKS} --images 4 --first 60000 "
        f"--count {HELDOUT} --mix demonstrations --jobs 1"
    )
    stores = [EpisodeStore(tmp_path / name) for name in ("whole", "masked", "silent")]
    damage(*stores)
    found = {}
    for name in ("masked", "silent"):
        for seed in SEEDS:
            model = tmp_path / name / f"{seed}.safetensors"
            run(
                f"train world-model --episodes {tmp_path}/{name} --heldout {tmp_path}/heldout "
                f"--seed {seed} {STEPS} --output {model}"
            )
            run(
                f"evaluate prediction --checkpoint {model} --horizon rollouts "
                f"--episodes {tmp_path}/heldout --metrics {METRICS} --baselines copy "
                f"--json {tmp_path}/{name}-{seed}.json"
            )
            found[name, seed] = json.loads((tmp_path / f"{name}-{seed}.json").read_text())
    for metric, is_better in (("contact_f1", 1), ("tactile_mse", -1)):
        gains = [
            is_better * (figure(found["masked", s], metric) - figure(found["silent", s], metric))
            for s in SEEDS
        ]
        assert min(gains) > 0


def figure(result, metric):
    return result["rollouts"]["all"]["model"][metric]
