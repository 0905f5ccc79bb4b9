"""A world that adds up, served as `dextouch serve` serves its worlds; its digest is in a file."""

import os
import sys
import time
from functools import partial
from pathlib import Path

from dextouch.errors import InvalidInputError, UnavailableError
from dextouch.schemas import EVERYTHING
from dextouch.serving import load_settings, service_config
from dextouch.worlds import WorldServiceSettings, serve_worlds
from tests.unit.worlds.fakes import SumWorld

STEP_S = 0.005


class SumSettings(WorldServiceSettings):
    """Serve a world that adds up.

    Example:
      sum_service --digests runs/digests
    """

    model_config = service_config("sum")

    digests: Path
    """One digest a line; the first one is served, the others are reopened."""
    step_s: float = STEP_S


class SlowSumWorld(SumWorld):
    def __init__(self, digest, step_s):
        super().__init__(digest=digest)
        if step_s < 0:
            raise InvalidInputError(f"step_s: got {step_s}, expected at least 0")
        self._step_s = step_s

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        time.sleep(self._step_s)
        return super().step(state, actions, seed=seed, selector=selector)

    def restore(self, data):
        # The last act of warming up.
        print(f"restored in [{os.getpid()}]", flush=True)  # noqa: T201 - for Service.workers
        return super().restore(data)


def worlds(settings):
    return {"sum": SlowSumWorld(settings.digests.read_text().split()[0], settings.step_s)}


def reopen(settings, name, digest):
    known = name == "sum" and digest in settings.digests.read_text().split()
    return SlowSumWorld(digest, settings.step_s) if known else None


if __name__ == "__main__":
    load = partial(load_settings, SumSettings, sys.argv[1:])
    given = load()
    try:
        serve_worlds(
            partial(worlds, given), given, name="sum", reopen=partial(reopen, given), load=load
        )
    except UnavailableError as error:
        sys.exit(error.message)
