"""Services of compose files as containers of podman, which read every key that the files use."""

import os
import signal
import time
from dataclasses import dataclass, field

import yaml

from tests.containers.engine import ROOT, Engine
from tests.system.compose_processes import free_port, interpolate, start_order, wait_for

HEALTH_TIMEOUT_S = 600.0
NETWORK = "dextouch"
READ = {
    *("image", "build", "command", "environment", "healthcheck", "depends_on", "ports", "profiles"),
    *("restart", "read_only", "cap_drop", "security_opt", "tmpfs", "stop_grace_period", "user"),
    *("volumes", "device_cgroup_rules", "group_add", "ulimits"),
}


def merged(paths):
    """Services of compose files laid over each other: lists are joined, mappings merged."""
    services = {}
    for path in paths:
        for name, service in yaml.safe_load(path.read_text())["services"].items():
            known = services.setdefault(name, {})
            for key, value in service.items():
                assert key in READ, f"{path.name}: {name}.{key} is not tested by anything"
                if isinstance(value, list) and key not in {"command", "test"}:
                    known[key] = known.get(key, []) + value
                elif isinstance(value, dict) and key in known:
                    known[key] = known[key] | value
                else:
                    known[key] = value
    return services


@dataclass
class Composed:
    """Runs services as `docker compose up` would, on ports of their own.

    Args:
        variables: those of the environment or `.env`.
        paths: compose files.
    """

    engine: Engine
    variables: dict
    paths: tuple = (ROOT / "docker-compose.yml",)
    started_s: dict = field(default_factory=dict)

    def __post_init__(self):
        self.services = merged(self.paths)
        if self.engine.podman("network", "exists", NETWORK, check=False).returncode != 0:
            self.engine.podman("network", "create", NETWORK)
        for service in self.services.values():
            for port in service.get("ports", []):
                variable = port.split("{")[1].partition(":")[0]
                self.variables.setdefault(variable, str(free_port()))

    def url(self, name, inside=8000):
        """Where a service can be reached from this machine."""
        ports = [port for port in self.services[name]["ports"] if port.endswith(f":{inside}")]
        host, port, _ = interpolate(ports[0], self.variables).split(":")
        return f"http://{host}:{port}"

    def words(self, name, *, environment=(), volumes=None, flags=()):
        """Arguments of `podman run` for a service; `volumes` replaces some by podman's flags."""
        service = self.services[name]
        words = ["--detach", "--name", name, "--network", f"{NETWORK}:alias={name}"]
        for key, value in (service.get("environment", {}) | dict(environment)).items():
            words += ["--env", f"{key}={interpolate(str(value), self.variables)}"]
        for volume in service.get("volumes", []):
            source, inside, *mode = volume.split(":")
            if volumes and inside in volumes:
                words += list(volumes[inside])
                continue
            place = str(ROOT / source) if source.startswith(".") else source
            words += ["--volume", ":".join([place, inside, *mode])]
        for port in service.get("ports", []):
            words += ["--publish", interpolate(port, self.variables)]
        for key, flag in (
            ("cap_drop", "--cap-drop"),
            ("security_opt", "--security-opt"),
            ("tmpfs", "--tmpfs"),
            ("device_cgroup_rules", "--device-cgroup-rule"),
            ("group_add", "--group-add"),
        ):
            for value in service.get(key, []):
                # Podman knows the option without a value, and mounts without docker's noexec.
                option = value.removesuffix(":true") if key == "security_opt" else value
                option += ":noexec,nosuid,nodev" if key == "tmpfs" else ""
                words += [flag, interpolate(option, self.variables)]
        words += ["--read-only", "--read-only-tmpfs=false"] if service.get("read_only") else []
        words += ["--user", service["user"]] if "user" in service else []
        words += ["--stop-timeout", service["stop_grace_period"].removesuffix("s")]
        words += ["--restart", service["restart"]]
        # Without systemd, podman runs none by itself: wait_healthy does.
        words += ["--no-healthcheck", *flags]
        return [*words, _full(service["image"]), *service.get("command", [])]

    def run_once(self, name, *command, network="none", environment=()):
        """Run a service, or another command as it, beside the others until it ends."""
        words = self.words(name, environment=environment)
        for flag in ("--name", "--network", "--publish", "--restart"):
            while flag in words:
                at = words.index(flag)
                del words[at : at + 2]
        own = self.services[name]["command"]
        words = [*words[1 : -len(own)], *(command or own)]
        return self.engine.podman("run", "--rm", "--network", network, *words, check=False)

    def up(self, name, **changes):
        """Start a service and wait for its own health check; seconds that it took."""
        started_s = time.monotonic()
        self.engine.podman("run", *self.words(name, **changes))
        self.wait_healthy(name)
        self.started_s[name] = time.monotonic() - started_s
        return self.started_s[name]

    def up_all(self):
        """Start all lasting services, each after those that it depends on."""
        for name in self.lasting():
            self.up(name)

    def lasting(self):
        """Services of no profile, each after those that it depends on."""
        return start_order({n: s for n, s in self.services.items() if not s.get("profiles")})

    def wait_healthy(self, name):
        """Run the health check of a container until it passes."""
        deadline_s = time.monotonic() + HEALTH_TIMEOUT_S
        kind, *command = self.services[name]["healthcheck"]["test"]
        assert kind == "CMD"
        while self.engine.podman("exec", name, *command, check=False).returncode != 0:
            assert time.monotonic() < deadline_s, f"{name} is not healthy\n{self.log(name)}"
            time.sleep(0.5)

    def pid(self, name):
        """Process of a container as this machine counts it."""
        return self.engine.inspect(name, ".State.Pid")

    def signal(self, name, number):
        """Send a signal to the first process of a container, once it runs; its id."""
        # 0 while it is started again, which would be this process and its group.
        wait_for(f"{name} to run", 120, lambda: self.pid(name) > 0, self.logs)
        pid = self.pid(name)
        assert pid > 0, f"{name} does not keep running\n{self.log(name)}"
        os.kill(pid, number)
        return pid

    def kill(self, name):
        """End a container as the kernel does, and start it as `restart: unless-stopped` does."""
        old_pid = self.signal(name, signal.SIGKILL)
        wait_for(f"end of {name}", 120, lambda: self.pid(name) != old_pid, self.logs)
        # Podman without systemd may leave this to whoever runs it.
        if not self.engine.inspect(name, ".State.Running"):
            self.engine.podman("start", name)

    def stop(self, name):
        """Stop a container as compose does; seconds and exit status."""
        started_s = time.monotonic()
        self.engine.podman("stop", name)
        return time.monotonic() - started_s, self.engine.inspect(name, ".State.ExitCode")

    def log(self, name, num_lines=40):
        """The end of a container's log."""
        done = self.engine.podman("logs", "--tail", num_lines, name, check=False)
        return f"--- {name}\n{done.stdout}{done.stderr}"

    def logs(self):
        """The end of every log, for a failure's report."""
        return "\n".join(self.log(name) for name in self.started_s)

    def down(self, *names):
        """Remove containers, all without names."""
        self.engine.podman("rm", "--force", "--time", "0", *(names or ("--all",)))


def _full(image):
    """The name under which podman holds an image of the compose file."""
    if image.startswith("dextouch:"):
        return f"localhost/{image}"
    return f"docker.io/{image}" if "/" in image else f"docker.io/library/{image}"
