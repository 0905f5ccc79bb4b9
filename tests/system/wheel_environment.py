"""Environment outside the checkout in which only a built wheel provides `dextouch` and services.

Its third-party packages are links to the installed ones, exactly those that the wheel's extras name
and what these need in turn: a requirement that the wheel forgets is missing, and nothing is
downloaded but the build backend.
"""

import json
import os
import subprocess
import sys
import venv
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
NAME = "dextouch-wm"
WEIGHTS = "dextouch-wm-weights"
# It has 3.1 MB: 0.5 MB are Swagger UI, which stations without a network show, too; 0.3 MB pictures.
MAX_WHEEL_BYTES = 3_300_000
# Python imports it at every start; paths of the checkout that anything opens or lists are noted.
WATCH = """
import os, sys
CHECKOUT, INSTALLED, NOTES = {checkout!r}, {installed!r}, {notes!r}

def watch(event, arguments):
    if event not in ("open", "os.listdir", "os.scandir", "import") or not arguments:
        return
    for path in arguments[:2]:
        if isinstance(path, (str, bytes)):
            path = os.fsdecode(path)
            if path.startswith(CHECKOUT) and not path.startswith(INSTALLED):
                with os.fdopen(os.open(NOTES, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "a") as file:
                    file.write(path + "\\n")

sys.addaudithook(watch)
"""


@dataclass(frozen=True)
class WheelEnvironment:
    """A virtual environment with the wheels, and the folder in which its commands run."""

    wheel: Path
    weights: Path
    folder: Path
    notes: Path

    @property
    def bin(self) -> Path:
        return self.folder / "venv/bin"

    @property
    def site_packages(self) -> Path:
        return self.folder / f"venv/lib/python3.{sys.version_info.minor}/site-packages"

    def start(self, *words: str, **more: object) -> subprocess.Popen[str]:
        """Start a command of the environment, without anything of ours in its variables."""
        left_out = ("PYTHON", "DEXTOUCH_", "VIRTUAL_ENV")
        kept = {key: v for key, v in os.environ.items() if not key.startswith(left_out)}
        return subprocess.Popen(
            [str(self.bin / words[0]), *words[1:]],
            cwd=self.folder,
            env=kept,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            **more,
        )

    def run(self, *words: str, limit_s: float = 120) -> str:
        """Standard output of a command that must succeed."""
        running = self.start(*words)
        out, errors = running.communicate(timeout=limit_s)
        assert running.returncode == 0, errors[-4000:]
        return out

    def opened_in_the_checkout(self) -> list[str]:
        """Paths of the checkout that a command has opened or listed."""
        return self.notes.read_text().splitlines() if self.notes.exists() else []


PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")


def build_wheels(folder: Path) -> tuple[Path, Path]:
    """Build the wheels of code and weights."""
    sources = [str(ROOT), str(ROOT / "weights")]
    made = [*PIP, "wheel", "--no-deps", "--wheel-dir", str(folder), *sources]
    subprocess.run(made, check=True, timeout=600)
    (wheel,), (weights,) = folder.glob("dextouch_wm-*"), folder.glob("dextouch_wm_weights-*")
    return wheel, weights


def build(folder: Path, extras: tuple[str, ...]) -> WheelEnvironment:
    """Build the wheels and an environment with them and what these extras name."""
    wheel, weights = build_wheels(folder / "dist")
    venv.create(folder / "venv", with_pip=False, symlinks=True)
    found = WheelEnvironment(wheel, weights, folder, folder / "opened.txt")
    # Compiled, since commands start many processes.
    wanted = required(wheel, extras)
    install = ["install", "--no-deps", "--no-index", str(wheel)]
    if WEIGHTS in wanted:
        install.append(str(weights))
    python = ["--python", str(found.bin / "python")]
    subprocess.run([*PIP, *python, *install], check=True, timeout=600)
    for name in wanted:
        if name != WEIGHTS:
            link(name, found.site_packages)
    text = WATCH.format(
        checkout=f"{ROOT}/", installed=f"{Path(sys.prefix)}/", notes=str(found.notes)
    )
    (found.site_packages / "sitecustomize.py").write_text(text)
    return found


def required(wheel: Path, extras: tuple[str, ...]) -> list[str]:
    """Names of all distributions that the wheel needs with these extras."""
    (own,) = metadata.distributions(name=NAME, path=[str(wheel)])
    wanted = [(own, extras)]
    seen: set[tuple[str, str]] = set()
    while wanted:
        distribution, of_extras = wanted.pop()
        for line in distribution.requires or ():
            requirement = Requirement(line)
            name = canonicalize_name(requirement.name)
            for extra in of_extras or ("",):
                if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
                    continue
                new = tuple(e for e in requirement.extras or {""} if (name, e) not in seen)
                seen |= {(name, e) for e in new}
                if new and name != WEIGHTS:
                    found = own if name == NAME else metadata.distribution(name)
                    wanted.append((found, new))
    return sorted({name for name, _ in seen} - {NAME})


def link(name: str, site_packages: Path) -> None:
    """Link the top-level packages, modules and metadata of an installed distribution."""
    files = metadata.distribution(name).files
    assert files is not None, f"{name} has no list of files"
    for top in sorted({file.parts[0] for file in files}):
        source = Path(str(metadata.distribution(name).locate_file(top)))
        skipped = top in {"..", "__pycache__"} or top.endswith(".pth")
        if not skipped and source.exists() and not (site_packages / top).exists():
            (site_packages / top).symlink_to(source)


def own_packages(environment: WheelEnvironment) -> dict[str, str]:
    """Where the environment's Python finds both packages."""
    code = (
        "import json, dextouch_services as services, dextouch;"
        "print(json.dumps({'services': services.__path__[0], 'dextouch': dextouch.__file__}))"
    )
    return json.loads(environment.run("python", "-c", code))
