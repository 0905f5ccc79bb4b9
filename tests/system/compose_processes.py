"""A compose file in, its services as plain processes on free loopback ports out."""

import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from pathlib import Path

import yaml

from tests.programs import needed_program

VARIABLE = re.compile(r"\$\{(\w+)(?::([-?])([^}]*))?\}")
CONTAINER_PORTS = {"redis": 6379}
SERVICE_PORT = 8000
HEALTH_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 10.0


def free_port():
    """A port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def interpolate(value, variables):
    """`${NAME}`, `${NAME:-default}` and `${NAME:?reason}` as compose reads them."""

    def fill(match):
        name, kind, text = match.groups()
        if variables.get(name):
            return variables[name]
        if kind == "-":
            return text
        raise KeyError(f"{name}: {text or 'not set'}")

    return VARIABLE.sub(fill, value)


def keys_of(path):
    """A new key for each variable that a compose file needs."""
    needed = {name for name, kind, _ in VARIABLE.findall(path.read_text()) if kind == "?"}
    return {name: secrets.token_hex(32) for name in needed}


def start_order(services):
    """Names of services so that each comes after what it depends on."""
    return list(
        TopologicalSorter({n: s.get("depends_on", {}) for n, s in services.items()}).static_order()
    )


def wait_for(what, limit_s, condition, logs):
    """Poll other processes; fails with their logs."""
    deadline_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline_s, f"{what} not within {limit_s} s\n{logs()}"
        time.sleep(0.1)


def record_take(ask, take_s, logs):
    """Record and save one take of the mock station; its id and the number of samples by stream."""
    prompt = {"task": "stand_bottle", "instruction": "stand the bottle up", "consent": True}
    ask("POST", "acquisition", "/v1/recorder/arm", json=prompt)
    started = ask("POST", "acquisition", "/v1/recorder/record")
    wait_for(
        f"{take_s} s of recording",
        3 * take_s,
        lambda: ask("GET", "acquisition", "/v1/recorder")["duration_s"] >= take_s,
        logs,
    )
    stopped = ask("POST", "acquisition", "/v1/recorder/stop")
    assert stopped["state"] == "checking"
    save = {"success": True, "accept_incomplete": True}
    assert ask("POST", "acquisition", "/v1/recorder/save", json=save)["state"] == "saved"
    num_samples = {take["stream"]: take["num_samples"] for take in stopped["check"]["streams"]}
    return started["recording_id"], num_samples


@dataclass
class Running:
    """One service as a process."""

    name: str
    port: int
    environment: dict
    log_path: Path
    process: subprocess.Popen
    exit_s: float | None = None

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}"

    def log_tail(self, num_lines=40):
        return "\n".join(self.log_path.read_text(errors="replace").splitlines()[-num_lines:])


@dataclass
class ComposeProcesses:
    """Starts what `docker compose up` would start, in its order; stops it in reverse."""

    path: Path
    folder: Path
    variables: dict
    without: tuple = ()
    running: dict = field(default_factory=dict)

    def __post_init__(self):
        self.services = {
            name: service
            for name, service in yaml.safe_load(self.path.read_text())["services"].items()
            if not service.get("profiles") and name not in self.without
        }
        self.ports = {name: free_port() for name in self.services}

    def start(self):
        """Start all, waiting for the health of what others depend on."""
        for name in start_order(self.services):
            depends_on = self.services[name].get("depends_on", {})
            for other, rule in depends_on.items():
                if rule["condition"] == "service_healthy":
                    self.wait_healthy(other)
            self._start(name)
        for name in self.running:
            self.wait_healthy(name)

    def _start(self, name):
        service = self.services[name]
        environment = self._environment(name)
        log_path = self.folder / f"{name}.log"
        working_folder = self.folder / name
        working_folder.mkdir()
        with log_path.open("wb") as log:
            process = subprocess.Popen(
                self._command(name, service["command"]),
                env=environment,
                cwd=working_folder,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self.running[name] = Running(name, self.ports[name], environment, log_path, process)

    def _command(self, name, command):
        words = [self._local(interpolate(word, self.variables), name) for word in command]
        if words[0] == "dextouch":
            return [sys.executable, "-m", "services.cli.main", *words[1:]]
        if words[0] == "redis-server":
            port = ["--port", str(self.ports[name]), "--bind", "127.0.0.1"]
            return [needed_program("redis-server", package="redis-server"), *words[1:], *port]
        raise AssertionError(f"{name}: a command this test cannot start: {command}")

    def _environment(self, name):
        kept = ("PATH", "HOME", "LANG", "OMP_NUM_THREADS", "PYTHONPATH")
        environment = {key: os.environ[key] for key in kept if key in os.environ}
        environment["PYTHONUNBUFFERED"] = "1"
        for key, value in self.services[name].get("environment", {}).items():
            environment[key] = self._local(interpolate(str(value), self.variables), name)
            if key.endswith("_PORT"):
                environment[key] = str(self.ports[name])
        return environment

    def _local(self, text, name):
        """Hosts, ports and folders of containers → those of this machine."""
        for other, port in self.ports.items():
            inside = CONTAINER_PORTS.get(other, SERVICE_PORT)
            text = text.replace(f"//{other}:{inside}", f"//127.0.0.1:{port}")
        text = text.replace(f"127.0.0.1:{SERVICE_PORT}", f"127.0.0.1:{self.ports[name]}")
        if text == "0.0.0.0":  # noqa: S104 - it is replaced, not bound
            return "127.0.0.1"
        for volume in self.services[name].get("volumes", []):
            source, inside = volume.split(":")[:2]
            folder = self.folder / "volumes" / source
            folder.mkdir(parents=True, exist_ok=True)
            text = text.replace(inside, str(folder))
        return text

    def wait_healthy(self, name):
        """Run the compose file's own health check until it passes."""
        running = self.running[name]
        test = self.services[name]["healthcheck"]["test"]
        assert test[0] == "CMD", f"{name}: health checks are written as CMD lists"
        command = [sys.executable if word == "python" else word for word in test[1:]]
        if command[0] == "redis-cli":
            program = needed_program("redis-cli", package="redis-tools")
            command = [program, "-p", str(running.port), *command[1:]]
        deadline_s = time.monotonic() + HEALTH_TIMEOUT_S
        while True:
            assert running.process.poll() is None, f"{name} ended by itself\n{running.log_tail()}"
            check = subprocess.run(
                command, env=running.environment, capture_output=True, timeout=10, check=False
            )
            if check.returncode == 0:
                return
            assert time.monotonic() < deadline_s, (
                f"{name} not healthy after {HEALTH_TIMEOUT_S:g} s: "
                f"{check.stderr.decode(errors='replace')[-300:]}\n{running.log_tail()}"
            )
            time.sleep(0.2)

    def stop(self):
        """SIGTERM in reverse order; seconds each needed, None for one that had to be killed."""
        for name in reversed(list(self.running)):
            running = self.running[name]
            if running.process.poll() is not None:
                continue
            started_s = time.monotonic()
            running.process.send_signal(signal.SIGTERM)
            try:
                running.process.wait(STOP_TIMEOUT_S)
                running.exit_s = time.monotonic() - started_s
            except subprocess.TimeoutExpired:
                os.killpg(running.process.pid, signal.SIGKILL)
                running.process.wait()

    def logs(self):
        """The end of every log, for a failure's report."""
        return "\n".join(f"--- {name}\n{r.log_tail()}" for name, r in self.running.items())
