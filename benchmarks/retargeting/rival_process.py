"""Solver of another library in a child process with a limit of processor time per call.

A library that never returns, as one does for NaN, would block the whole measurement. Its process
therefore sets a timer before each call, which kills the process. The timer counts processor time,
not wall time, so a busy machine does not abort a call. Run as a module, this is the child process.
"""

import signal
import sys
import tempfile
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.retargeting.rivals import RIVALS, Rival, Setup, Timed, set_up
from benchmarks.simulated.hand_motions import Motion
from dextouch.errors import InvalidInputError, LimitExceededError, UnavailableError
from dextouch.hands.robot_hand import RobotHand
from dextouch.serving import ChildProcess, serve_parent

MODULE: Final = "benchmarks.retargeting.rival_process"
# Limit of processor time; the slowest call of a library takes hundredths of a second.
CALL_LIMIT_S = 10.0
# Libraries start in the middle of all limits and need some samples to converge; these are not
# measured.
NUM_WARM_UP = 10


class RivalProcess(AbstractContextManager["RivalProcess"]):
    """One rival in its own process, started on the first request and after a timeout."""

    def __init__(self, rival: Rival) -> None:
        self.rival = rival
        self._child: ChildProcess | None = None

    def __exit__(self, *error: object) -> None:
        if self._child is not None:
            self._child.close()

    def run(self, motion: Motion, scale: float) -> Timed:
        """Joint angles of a motion, sample by sample, from a fresh retargeter.

        Raises LimitExceededError if a call did not return within 10 s of processor time,
        InvalidInputError if the rival refuses the keypoints, and UnavailableError if its library is
        not installed, or the process ended by itself.
        """
        if self._child is None:
            environment = {"OMP_NUM_THREADS": "1"}
            self._child = ChildProcess(MODULE, self.rival.name, environment=environment)
        keypoints_m = motion.keypoints_m.tolist()
        self._child.send({"side": motion.side, "scale": scale, "keypoints_m": keypoints_m})
        try:
            answer = self._child.receive()
        except UnavailableError as error:
            # The next request starts another process.
            self._child = None
            if error.details["exit_status"] != -signal.SIGPROF:
                raise UnavailableError(f"{self.rival.name}: {error.message}") from error
            raise LimitExceededError(
                f"{self.rival.name}: a call did not return within {CALL_LIMIT_S:g} s of processor "
                "time",
                limit_s=CALL_LIMIT_S,
            ) from error
        if "refused" in answer:
            raise InvalidInputError(f"{self.rival.name}: {answer['refused']}")
        return Timed(np.array(answer["joints_rad"]), answer["cpu_s"], np.array(answer["call_s"]))


def serve(name: str) -> None:
    """Process requests until the end of input, each call of the rival with the timer set."""
    requests, answer = serve_parent(niceness=0)
    with tempfile.TemporaryDirectory(prefix="dextouch-bench-") as folder:
        for request in requests:
            keypoints, side = np.array(request["keypoints_m"]), request["side"]
            setup = set_up(
                RIVALS[name], keypoints, side, scale=request["scale"], folder=Path(folder)
            )
            try:
                joints, times = follow(setup)
            except (ValueError, RuntimeError) as error:
                answer({"refused": str(error)})
                continue
            order = [setup.joint_names.index(joint) for joint in RobotHand(side).joint_names]
            answer({"joints_rad": joints[:, order].tolist(), **times})


def follow(setup: Setup) -> tuple[np.ndarray, dict[str, Any]]:
    """Run the rival on all references, one call per sample, after a warm-up on the first.

    Returns joint angles [T, joints] in its own order, and the times: `cpu_s` of all calls and
    `call_s` of each, without the time between calls.
    """
    warm_up = setup.references[:1] * NUM_WARM_UP
    joints, calls_s, cpus_s = [], [], []
    try:
        for reference in [*warm_up, *setup.references]:
            signal.setitimer(signal.ITIMER_PROF, CALL_LIMIT_S)
            begun_s, cpu_begun_s = time.perf_counter(), time.process_time()
            answer = setup.solve(reference)
            cpus_s.append(time.process_time() - cpu_begun_s)
            calls_s.append(time.perf_counter() - begun_s)
            joints.append(np.asarray(answer, dtype=np.float64))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    times = {"cpu_s": sum(cpus_s[NUM_WARM_UP:]), "call_s": calls_s[NUM_WARM_UP:]}
    return np.array(joints[NUM_WARM_UP:]), times


if __name__ == "__main__":
    serve(sys.argv[1])
