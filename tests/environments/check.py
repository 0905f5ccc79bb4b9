"""Install the package beside others, for several Pythons and versions, and check it there.

Run by `make check-environments`; needs uv, which makes each environment in a temporary folder and
removes it again. Arguments select cases by a part of their name; `model` cases download torch.
"""

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
NEWEST, OLDEST = "highest", "lowest-direct"
LEROBOT_IN_3_11, LEROBOT = "lerobot>=0.4.4,<0.5", "lerobot[dataset]>=0.6.1"


@dataclass(frozen=True)
class Case:
    """An environment, and the script that runs in it with modules to import first."""

    name: str
    python: str
    resolution: str
    extras: str = "store"
    beside: tuple[str, ...] = ()
    script: str = "store_check.py"
    modules: tuple[str, ...] = ()


CASES = (
    *(Case(f"store newest {v}", v, NEWEST) for v in ("3.11", "3.12", "3.13")),
    *(Case(f"store oldest {v}", v, OLDEST) for v in ("3.11", "3.13")),
    Case("lerobot 3.11", "3.11", NEWEST, beside=(LEROBOT_IN_3_11,), modules=("lerobot", "torch")),
    Case("lerobot 3.12", "3.12", NEWEST, beside=(LEROBOT,), modules=("lerobot", "torch")),
    Case("lerobot 3.13", "3.13", NEWEST, beside=(LEROBOT,), modules=("lerobot", "torch")),
    Case("all lerobot 3.12", "3.12", NEWEST, "all", (LEROBOT,), "model_check.py", ("lerobot",)),
    Case("model oldest 3.11", "3.11", OLDEST, "model", script="model_check.py"),
    Case("model newest 3.13", "3.13", NEWEST, "model", script="model_check.py"),
)


def uv(*words, cwd=ROOT):
    """Run uv; its output is an error's, where it fails."""
    done = subprocess.run(["uv", *words], cwd=cwd, text=True, capture_output=True, check=False)
    if done.returncode:
        raise RuntimeError(f"uv {' '.join(words[:2])}: {done.stderr.strip()[-1500:]}")
    return done.stdout + done.stderr


def check(case, folder):
    """Make the environment of a case and run its script there; the last line it prints."""
    python = str(folder / "venv/bin/python")
    uv("venv", "--python", case.python, str(folder / "venv"))
    weights = [str(ROOT / "weights")] if case.extras in {"model", "all"} else []
    wanted = [f"{ROOT}[{case.extras}]", *weights, *case.beside]
    uv("pip", "install", "--python", python, "--resolution", case.resolution, *wanted)
    uv("pip", "check", "--python", python)
    done = subprocess.run(
        [python, str(HERE / case.script), *case.modules],
        cwd=folder,
        text=True,
        capture_output=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{case.script}: {done.stderr.strip()[-1500:]}")
    return done.stdout.strip().rpartition("\n")[2]


def main():
    """Check the selected cases; 1 if one fails."""
    chosen = [c for c in CASES if not sys.argv[1:] or any(part in c.name for part in sys.argv[1:])]
    failed = 0
    for case in chosen:
        started = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="dextouch_environment_") as folder:
            try:
                told = f"ok: {check(case, Path(folder))}"
            except RuntimeError as error:
                told, failed = f"FAILED: {error}", failed + 1
        print(f"{case.name:20} {time.monotonic() - started:5.0f} s  {told}", flush=True)
    print(f"{len(chosen) - failed} of {len(chosen)} environments are right")
    return 1 if failed or not chosen else 0


if __name__ == "__main__":
    sys.exit(main())
