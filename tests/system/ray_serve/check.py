"""Kill replicas of a Ray Serve deployment while rollouts run; opt-in: make check-ray.

Runs in an environment of its own, which has Ray. Every response is compared with what must come.
"""

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import ray
from ray import serve

from dextouch.worlds import WorldServiceSettings, create_serving_app
from services.pipelines.ray_serve import application
from tests.contracts.redis_server import running_redis
from tests.system.scaled import ROOT, Load, free_port, wait_until
from tests.unit.worlds.fakes import SumWorld

NUM_REPLICAS = 2


def sum_worlds():
    return {"sum": SumWorld()}


def replicas():
    """Process ids of the replicas."""
    return [
        process.info["pid"]
        for process in psutil.process_iter(["cmdline", "pid"])
        if any(word.startswith("ray::ServeReplica") for word in process.info["cmdline"] or ())
    ]


def are_ready():
    """Whether as many replicas serve as there are to be."""
    deployment = serve.status().applications["default"].deployments["worlds"]
    return deployment.replica_states.get("RUNNING") == len(replicas()) == NUM_REPLICAS


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--rollouts", type=int, default=4)
    options = parser.parse_args()
    num_kills = options.kills
    rng, kills_s = random.Random(num_kills), []
    with (
        tempfile.TemporaryDirectory() as folder,
        running_redis(Path(folder)) as redis_url,
    ):
        port = free_port()
        environment = {"PYTHONPATH": f"{ROOT}:{ROOT / 'shared'}"}
        ray.init(num_cpus=4, include_dashboard=False, runtime_env={"env_vars": environment})
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        settings = WorldServiceSettings(state_url=redis_url)
        create_app = partial(create_serving_app, sum_worlds, settings, "sum")
        serve.run(application(create_app, settings, num_replicas=NUM_REPLICAS))
        try:
            with Load(f"http://127.0.0.1:{port}", options.rollouts) as load:
                for _ in range(num_kills):
                    wait_until(are_ready, "all replicas")
                    load.advance()
                    kills_s.append(time.monotonic())
                    os.kill(rng.choice(replicas()), signal.SIGKILL)
                    load.advance()
        finally:
            serve.shutdown()
            ray.shutdown()
    assert not load.mistakes, load.mistakes
    around_ms = [1e3 * (b - a) for a, b in load.times_s if any(a <= t <= b for t in kills_s)]
    print(  # noqa: T201 - it is what the check is run for
        f"{num_kills} kills, {sum(load.num_chunks)} chunks of {load.num_rollouts} rollouts, "
        f"0 lost, wrong or doubled; chunks during a kill: p50 "
        f"{np.median(around_ms):.0f} ms, max {max(around_ms):.0f} ms; load {os.getloadavg()[0]:.1f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
