"""Solver of another library in a child process with a limit of processor time per call.

A library that never returns, as one does for NaN, would block the whole measurement. Its process
therefore sets a timer before each call, which kills the process. The timer counts processor time,
not wall time, so a busy machine does not abort a call. Run as a module, this is the child process:
requests on standard input and responses on standard output are a line of JSON followed by arrays as
bytes.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from benchmarks.retargeting.ours import Timed
from benchmarks.retargeting.rivals import Rival, Setup, find_rival, set_up
from benchmarks.simulated.hand_motions import Motion
from dextouch.errors import InvalidInputError, LimitExceededError, UnavailableError
from dextouch.hands import NUM_KEYPOINTS
from dextouch.hands.robot_hand import NUM_JOINTS, RobotHand

# Limit of processor time; the slowest call of a library takes hundredths of a second.
CALL_LIMIT_S = 10.0
# Libraries start in the middle of all limits and need some samples to converge; these are not
# measured.
NUM_WARM_UP = 10


class RivalProcess(AbstractContextManager["RivalProcess"]):
    """One rival in its own process, started on the first request and after a timeout."""

    def __init__(self, rival: Rival) -> None:
        self.rival = rival
        self._process: subprocess.Popen[bytes] | None = None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop()

    def __enter__(self) -> "RivalProcess":
        return self

    def run(self, motion: Motion, scale: float) -> Timed:
        """Joint angles of a motion, sample by sample, from a fresh retargeter.

        Raises:
            LimitExceededError: a call did not return within 10 s of processor time.
            InvalidInputError: the rival refuses the keypoints.
            UnavailableError: its library is not installed, or the process ended by itself.
        """
        process = self._running()
        if process.stdin is None or process.stdout is None:
            raise UnavailableError(f"{self.rival.name}: its process has no pipes")
        head = {"side": motion.side, "scale": scale, "num_samples": len(motion)}
        try:
            _send(process.stdin, head, motion.keypoints_m)
        except BrokenPipeError as error:
            raise self._ended() from error
        line = process.stdout.readline()
        if not line:
            raise self._ended()
        answer = json.loads(line)
        if "refused" in answer:
            raise InvalidInputError(f"{self.rival.name}: {answer['refused']}")
        joints = _receive(process.stdout, (len(motion), NUM_JOINTS))
        return Timed(joints, answer["cpu_s"], np.array(answer["call_s"]))

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            command = [sys.executable, "-m", __name__, self.rival.name]
            self._process = subprocess.Popen(  # noqa: S603 (this very module)
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        return self._process

    def _ended(self) -> LimitExceededError | UnavailableError:
        """Error for an ended process; the next request starts another one."""
        status = self._stop()
        if status == -signal.SIGPROF:
            return LimitExceededError(
                f"{self.rival.name}: a call did not return within {CALL_LIMIT_S:g} s of processor "
                "time",
                limit_s=CALL_LIMIT_S,
            )
        return UnavailableError(
            f"{self.rival.name}: its process ended with status {status}; see its output above"
        )

    def _stop(self) -> int | None:
        process, self._process = self._process, None
        if process is None:
            return None
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                # The buffer still holds what the dead process did not read.
                try:
                    pipe.close()
                except BrokenPipeError:
                    continue
        return process.wait()


def serve(name: str, requests: IO[bytes], answers: IO[bytes]) -> None:
    """Process requests until the end of input, each call of the rival with the timer set."""
    rival = find_rival(name)
    with tempfile.TemporaryDirectory(prefix="dextouch-bench-") as folder:
        while line := requests.readline():
            head = json.loads(line)
            keypoints = _receive(requests, (head["num_samples"], NUM_KEYPOINTS, 3))
            setup = set_up(rival, keypoints, head["side"], scale=head["scale"], folder=Path(folder))
            try:
                joints, times = follow(setup)
            except (ValueError, RuntimeError) as error:
                _send(answers, {"refused": str(error)}, np.empty(0))
                continue
            names = RobotHand(head["side"]).joint_names
            _send(answers, times, joints[:, [setup.joint_names.index(name) for name in names]])


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


def _send(pipe: IO[bytes], head: dict[str, Any], numbers: np.ndarray) -> None:
    pipe.write(json.dumps(head).encode() + b"\n")
    pipe.write(np.ascontiguousarray(numbers, dtype=np.float64).tobytes())
    pipe.flush()


def _receive(pipe: IO[bytes], shape: tuple[int, ...]) -> np.ndarray:
    size = int(np.prod(shape)) * 8
    content = pipe.read(size)
    if len(content) != size:
        raise UnavailableError(f"pipe: got {len(content)} bytes, expected {size}")
    return np.frombuffer(content, dtype=np.float64).reshape(shape)


def _main() -> None:
    # Libraries print to standard output, which is the response pipe, so it is redirected.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with answers:
        serve(sys.argv[1], sys.stdin.buffer, answers)


if __name__ == "__main__":
    _main()
