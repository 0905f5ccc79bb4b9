"""Faults at random in the whole set of containers, while takes are recorded and aligned."""

import os

import numpy as np
import pytest
import zarr

from dextouch.clients import RolloutClient
from tests.containers.chaos import Chaos, Operator, plan
from tests.system.compose_processes import record_take, wait_for

pytestmark = pytest.mark.containers
# Another sequence: DEXTOUCH_CHAOS_SEED=7 make containers
SEED = int(os.environ.get("DEXTOUCH_CHAOS_SEED", "1"))
NUM_EACH = 4
# What tells samples of a stream apart.
TIMES = ("t_host_ns", "t_device_ns", "sequence")
SETTLE_TIMEOUT_S = 400.0


def test_what_a_station_counted_is_in_the_store_once_after_any_faults(
    composed, disks, ask, key, note
):
    faults = plan(SEED, composed.lasting(), NUM_EACH)
    note(f"chaos, seed {SEED}: {'; '.join(map(str, faults))}")
    operator = Operator(composed.url("acquisition"), key)
    operator.start()
    try:
        Chaos(composed, disks).run(faults)
    finally:
        operator.stop()
    for name in composed.lasting():
        composed.wait_healthy(name)
    last_id, num_samples = record_take(ask, 3.0, composed.logs)
    operator.counted[last_id] = num_samples
    operator.ended.add(last_id)
    counted = {key: counts for key, counts in operator.counted.items() if sum(counts.values())}

    def recordings():
        return ask("GET", "episode_store", "/v1/recordings")["recordings"]

    def all_stored():
        return counted.keys() <= {item["recording_id"] for item in recordings()}

    wait_for("uploads", SETTLE_TIMEOUT_S, all_stored, composed.logs)
    check_stored(counted, operator.ended, recordings(), disks["store"].place / "recordings")
    uploads = {item["recording_id"]: item for item in ask("GET", "acquisition", "/v1/uploads")}
    assert all(uploads[name]["uploaded"] and not uploads[name]["refused"] for name in counted)
    num_episodes = check_aligned(ask, composed, counted)
    check_a_rollout(composed, key)
    note(
        f"chaos: {len(counted)} takes, {len(operator.ended)} of them ended by the operator, "
        f"{sum(sum(c.values()) for c in counted.values())} samples, {num_episodes} episodes; "
        f"the station said {sorted(operator.refusals)}"
    )


def check_stored(counted, ended, recordings, folder):
    """Every sample that was counted is there once, as zarr-python reads it."""
    for recording_id, counts in counted.items():
        (listed,) = [item for item in recordings if item["recording_id"] == recording_id]
        group = zarr.open_group(folder / recording_id, mode="r")
        for stream, count in counts.items():
            where = f"{recording_id} {stream}"
            kept = np.stack([group[f"{stream}_{name}"][:] for name in TIMES])
            num_kept = kept.shape[1]
            assert num_kept == listed["num_samples"][stream], where
            assert np.unique(kept, axis=1).shape[1] == num_kept, where
            assert num_kept == count if recording_id in ended else num_kept >= count, where


def check_aligned(ask, composed, counted):
    """Every take was aligned, unless it lacks data, which the job says; how many were."""

    def jobs():
        found = ask("GET", "alignment", "/v1/alignments", params={"limit": 1000})["alignments"]
        return {job["recording_id"]: job for job in found}

    def out_of_space(job):
        return job["state"] == "failed" and job["problem"]["status"] == 507

    def all_ended():
        found = jobs()
        return counted.keys() <= found.keys() and all(
            found[name]["state"] in {"done", "failed"} and not out_of_space(found[name])
            for name in counted
        )

    wait_for("alignments", SETTLE_TIMEOUT_S, all_ended, lambda: f"{jobs()}\n{composed.logs()}")
    done = [job for name, job in jobs().items() if name in counted and job["state"] == "done"]
    failed = [job for name, job in jobs().items() if name in counted and job not in done]
    for job in failed:
        # A recording with a gap or without a whole second; nothing else.
        assert job["problem"]["status"] == 422, job["problem"]
    assert done
    for job in done:
        episode_id = job["report"]["episode_id"]
        assert ask("GET", "episode_store", f"/v1/episodes/{episode_id}")["num_steps"] > 0
    return len(done)


def check_a_rollout(composed, key):
    """The twin answers through gateway and Redis again."""
    asked = {"task": "stand_bottle", "instruction": "stand the bottle up", "seed": 20_001}
    with (
        RolloutClient(composed.url("gateway", 8084), api_key=key) as client,
        client.start(world="twin", **asked) as rollout,
    ):
        seen = rollout.step(np.repeat(rollout.observation.action_reached[-1:], 8, axis=0))
    assert len(seen) == 8
