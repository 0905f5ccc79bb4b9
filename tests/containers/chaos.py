"""Seeded faults of containers, and an operator who records takes through all of them."""

import random
import signal
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field

import httpx

# Twice: what takes pass through.
DATA_PATH = ("acquisition", "episode_store", "alignment")
KINDS = ("kill", "pause", "cut", "full disk")
PROMPT = {"task": "stand_bottle", "instruction": "stand the bottle up", "consent": True}
TAKE_S = 3.0
ACTION_TIMEOUT_S = 180.0


@dataclass(frozen=True)
class Fault:
    """What happens to which container or disk: how long after the last one, and for how long."""

    kind: str
    name: str
    after_s: float
    lasts_s: float

    def __str__(self):
        lasts = "" if self.kind == "kill" else f" for {self.lasts_s:.1f} s"
        return f"+{self.after_s:.1f} s {self.kind} {self.name}{lasts}"


def plan(seed, services, num_each):
    """The faults of a seed: each kind equally often, in any order."""
    numbers = random.Random(seed)
    kinds = [kind for kind in KINDS for _ in range(num_each)]
    numbers.shuffle(kinds)
    chosen = {
        kind: ("spool", "store") if kind == "full disk" else (*services, *DATA_PATH)
        for kind in KINDS
    }
    return [
        Fault(
            kind,
            numbers.choice(chosen[kind]),
            after_s=numbers.uniform(1.0, 4.0),
            lasts_s=numbers.uniform(2.0, 8.0),
        )
        for kind in kinds
    ]


@dataclass
class Chaos:
    """Does faults to running containers; a fault goes on while the next one begins."""

    composed: object
    disks: dict
    _timers: list = field(default_factory=list)

    def run(self, faults):
        """All faults; returns once the last one is over."""
        for fault in faults:
            time.sleep(fault.after_s)
            undo = self._begin(fault)
            timer = threading.Timer(fault.lasts_s, undo)
            timer.start()
            self._timers.append(timer)
        for timer in self._timers:
            timer.join()

    def _begin(self, fault):
        """Begin a fault; a function that ends it."""
        name, composed = fault.name, self.composed
        if fault.kind == "kill":
            composed.kill(name)
            return lambda: None
        if fault.kind == "pause":
            composed.signal(name, signal.SIGSTOP)
            # To the process that runs then; harmless for one that was not stopped.
            return lambda: composed.signal(name, signal.SIGCONT)
        if fault.kind == "cut":
            self._cut(name, "--insert")
            return lambda: self._cut(name, "--delete")
        self.disks[name].fill()
        return self.disks[name].free

    def _cut(self, name, what):
        """Lose all packets of a container but those of its loopback, or stop doing so."""
        enter = ("nsenter", "--net", "--target", self.composed.pid(name))
        for chain, interface in (("INPUT", "--in-interface"), ("OUTPUT", "--out-interface")):
            rule = ("iptables", "--wait", what, chain, "!", interface, "lo", "--jump", "DROP")
            # A container that was killed meanwhile has a network of its own again.
            self.composed.engine.run(*enter, *rule, check=what == "--insert")


class Operator(threading.Thread):
    """Records one take after another, and repeats what is not answered.

    Attributes:
        counted: by take, the samples that the station has counted aloud; they may not get lost.
        ended: takes whose end the station has confirmed: there may be no other samples.
        refusals: reasons that the station gave meanwhile.
    """

    def __init__(self, url, key):
        super().__init__(name="operator")
        headers = {"authorization": f"Bearer {key}"}
        self._url = f"{url}/v1/recorder"
        self._client = httpx.Client(headers=headers, timeout=10, trust_env=False)
        self._stopping = threading.Event()
        self.counted, self.ended, self.refusals, self.failure = {}, set(), set(), None

    def run(self):
        try:
            while not self._stopping.is_set():
                self._take(f"chaos-{len(self.counted):03}")
        except AssertionError as error:
            self.failure = error

    def stop(self):
        """End after the present take."""
        self._stopping.set()
        self.join()
        self._client.close()
        if self.failure:
            raise self.failure

    def _take(self, recording_id):
        named = {"recording_id": recording_id}
        self.counted[recording_id] = {}
        if self._ask("POST", "/arm", PROMPT) is None or self._ask("POST", "/record", named) is None:
            return
        began_s = time.monotonic()
        while time.monotonic() - began_s < TAKE_S:
            status = self._ask("GET", "")
            if status["recording_id"] != recording_id:
                return  # the station was started again, and has recovered the take
            self.counted[recording_id] |= status["num_samples"]
            time.sleep(0.2)
        status = self._ask("POST", "/stop", named)
        if status is None:
            return
        streams = status["check"]["streams"]
        self.counted[recording_id] |= {one["stream"]: one["num_samples"] for one in streams}
        self.ended.add(recording_id)
        self._ask("POST", "/save", named | {"success": True, "accept_incomplete": True})

    def _ask(self, method, path, body=None):
        """Ask until there is an answer; None if the station knows nothing of the take."""
        deadline_s = time.monotonic() + ACTION_TIMEOUT_S
        while True:
            with suppress(httpx.TransportError):
                answer = self._client.request(method, self._url + path, json=body)
                if answer.is_success:
                    return answer.json()
                self.refusals.add(f"{answer.status_code} {answer.json()['detail']}")
                if answer.status_code == httpx.codes.CONFLICT:
                    return None
            assert time.monotonic() < deadline_s, f"{method} {path}: {self.refusals}"
            time.sleep(0.3)
