"""Podman and buildah with images, containers and networks in a folder of their own."""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import urllib.error
import urllib.request
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Programs and their Debian packages. netavark runs iptables, on which its package does not depend.
PACKAGES = {
    **{name: name for name in ("buildah", "podman", "runc", "iptables")},
    **{f"/usr/lib/podman/{name}": name for name in ("netavark", "aardvark-dns")},
    "mkfs.ext4": "e2fsprogs",
    "mount": "mount",
    "nsenter": "util-linux",
    # Makes the base images where no registry answers.
    "mmdebstrap": "mmdebstrap",
}
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")
BUILD_TIMEOUT_S = 1800
REGISTRY = "https://registry-1.docker.io/v2/"
# What this machine lacks by itself: cgroups of systemd, a journal, limits that only
# CAP_SYS_RESOURCE may raise. Locks in a file, since those in shared memory are everybody's.
CONTAINERS_CONF = """
[engine]
runtime = "runc"
cgroup_manager = "cgroupfs"
events_logger = "file"
lock_type = "file"
tmp_dir = "{folder}/tmp"
[network]
network_backend = "netavark"
network_config_dir = "{folder}/networks"
[containers]
default_ulimits = ["nofile={files}:{files}", "nproc=4096:4096"]
"""
STORAGE_CONF = """
[storage]
driver = "{driver}"
runroot = "{folder}/run"
graphroot = "{folder}/graph"
"""


def missing():
    """Why containers cannot be run here; empty if they can."""
    if os.getuid() != 0:
        return "only root can run containers without a daemon and a set-up of user namespaces"
    lacking = [program for program in PACKAGES if not shutil.which(program)]
    if "mmdebstrap" in lacking and answers(REGISTRY):
        lacking.remove("mmdebstrap")
    if lacking:
        packages = " ".join(PACKAGES[program] for program in lacking)
        return f"no {', '.join(lacking)}: apt-get install {packages}"
    return ""


class Engine:
    """A container engine of one folder; `close` removes all that it made.

    Args:
        folder: short, since sockets lie below it.
    """

    def __init__(self, folder):
        self.folder = folder
        files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        settings = {"folder": folder, "driver": _driver(folder), "files": files}
        for name, text in (
            ("containers.conf", CONTAINERS_CONF),
            ("storage.conf", STORAGE_CONF),
        ):
            (folder / name).write_text(text.format_map(settings))
        self.environment = os.environ | {
            "CONTAINERS_CONF": str(folder / "containers.conf"),
            "CONTAINERS_STORAGE_CONF": str(folder / "storage.conf"),
            "TMPDIR": str(folder),
        }

    def run(self, *words, check=True, timeout_s=120):
        """Run a program with this engine's settings; the text it wrote is part of a failure."""
        done = subprocess.run(
            [str(word) for word in words],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
        if check:
            assert done.returncode == 0, f"{' '.join(map(str, words))}\n{done.stdout}{done.stderr}"
        return done

    def podman(self, *words, **options):
        """Run podman."""
        return self.run("podman", *words, **options)

    def inspect(self, name, field):
        """One field of a container or an image, such as `.State.Pid`."""
        done = self.podman("inspect", "--format", f"{{{{json {field}}}}}", name)
        return json.loads(done.stdout)

    def build(self, tag, containerfile, *, context, flags=()):
        """Build an image, in the way of a machine whose pip may have a configuration of its own."""
        self.run(
            *("nice", "-n", max(0, 10 - os.nice(0)), "buildah", "bud"),
            *("--layers", "--format", "docker"),
            *("--isolation", "chroot", "--pull-never", *_package_sources(self.folder), *flags),
            *("-t", tag, "-f", containerfile, context),
            timeout_s=BUILD_TIMEOUT_S,
        )

    def close(self):
        """Remove containers, networks, mounts and files."""
        for words in (
            ("podman", "rm", "--all", "--force", "--time", "0"),
            ("podman", "network", "prune", "--force"),
            ("podman", "volume", "prune", "--force"),
            ("buildah", "rm", "--all"),
        ):
            self.run(*words, check=False)
        # Deepest first; of this folder alone.
        mounts = [line.split()[1] for line in Path("/proc/mounts").read_text().splitlines()]
        for place in sorted(mounts, reverse=True):
            if place.startswith(f"{self.folder}/"):
                self.run("umount", "--lazy", place, check=False)


@contextmanager
def engine_in(kept=None):
    """An engine in a new folder that is removed at the end, or in one that keeps its images."""
    folder = Path(kept or tempfile.mkdtemp(prefix="dextouch-", dir="/var/tmp"))
    folder.mkdir(parents=True, exist_ok=True)
    engine = Engine(folder)
    try:
        yield engine
    finally:
        engine.close()
        if kept is None:
            shutil.rmtree(folder)


def _driver(folder):
    """Overlays cannot lie on overlays, as inside of a container."""
    words = ["stat", "--file-system", "--format", "%T", str(folder)]
    kind = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    return "vfs" if kind == "overlayfs" else "overlay"


def _package_sources(folder):
    """Flags so that pip inside finds the packages that it finds on this machine."""
    flags = ["--volume", f"{CERTIFICATES}:{CERTIFICATES}:ro"] if CERTIFICATES.is_file() else []
    config = folder / "pip.conf"
    found = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"],
        capture_output=True,
        text=True,
        check=False,
        cwd="/",
    ).stdout
    lines, folders = ["[global]"], set()
    for line in found.splitlines():
        key, _, value = line.partition("=")
        name = key.rpartition(".")[2]
        if name in {"index-url", "extra-index-url", "find-links", "trusted-host"}:
            lines.append(f"{name} = {value.strip(chr(39))}")
            places = [Path(word.removeprefix("file://")) for word in value.strip("'").split()]
            # An index is a folder `simple` beside the files that it links to.
            folders |= {p.parent if p.name == "simple" else p for p in places if p.is_dir()}
    config.write_text("\n".join(dict.fromkeys(lines)) + "\n")
    flags += ["--volume", f"{config}:/etc/pip.conf:ro"]
    for place in folders:
        flags += ["--volume", f"{place}:{place}:ro"]
    return flags


def answers(url):
    """Whether something speaks HTTP there."""
    try:
        with urllib.request.urlopen(url, timeout=5):  # noqa: S310
            return True
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False
