"""Make a release: `make release VERSION=0.2.0`.

Writes the version into the package and the changelog, builds the wheels of code and
weights with their SHA-256 in `dist`, commits and tags. Nothing is pushed. Run `.ci/run` first.
"""

import argparse
import hashlib
import re
import subprocess
import sys
from datetime import UTC, date, datetime
from pathlib import Path

from packaging.version import InvalidVersion, Version

_UNRELEASED = "## Unreleased\n"
_PLACES = (
    ("pyproject.toml", r'(?m)^version = "(.+)"$'),
    ("weights/pyproject.toml", r'(?m)^version = "(.+)"$'),
    ("shared/dextouch/__init__.py", r'(?m)^__version__ = "(.+)"$'),
)


class ReleaseError(Exception):
    """Why no release can be made; nothing was changed."""


def main() -> int:
    """Make a release in the checkout of the current folder."""
    parser = argparse.ArgumentParser(prog="make release", description=__doc__)
    parser.add_argument("version", help="the new version, such as 0.2.0")
    options = parser.parse_args()
    root = Path.cwd()
    try:
        changed = prepare(root, options.version, datetime.now(UTC).date())
        wheels = make(root, options.version, changed)
    except ReleaseError as error:
        print(f"no release: {error}", file=sys.stderr)  # noqa: T201
        return 1
    tag = f"v{options.version}"
    made = ", ".join(map(str, wheels))
    print(f"made {tag} and {made}\npush them with: git push origin main {tag}")  # noqa: T201
    return 0


def prepare(root: Path, version: str, today: date) -> dict[str, str]:
    """New texts of the files that name the version, by path.

    Raises:
        ReleaseError: another branch than main, changes that are not committed, a version that is
            not newer, a tag that exists, or an empty section Unreleased.
    """
    try:
        new = Version(version)
    except InvalidVersion as error:
        raise ReleaseError(f"got version {version!r}, expected one such as 0.2.0") from error
    if str(new) != version:
        raise ReleaseError(f"got version {version!r}, expected {str(new)!r}, as wheels write it")
    branch = _git(root, "rev-parse", "--abbrev-ref", "HEAD")
    if branch != "main":
        raise ReleaseError(f"got branch {branch!r}, expected main")
    if dirty := _git(root, "status", "--porcelain"):
        raise ReleaseError(f"commit or undo these changes first:\n{dirty}")
    if _git(root, "tag", "--list", f"v{version}"):
        raise ReleaseError(f"the tag v{version} exists")
    changed = {}
    for name, pattern in _PLACES:
        text = (root / name).read_text(encoding="utf-8")
        found = re.search(pattern, text)
        if found is None:
            raise ReleaseError(f"{name}: found no version")
        if Version(found[1]) >= new:
            raise ReleaseError(f"{name}: has {found[1]}, expected a version before {version}")
        changed[name] = text[: found.start(1)] + version + text[found.end(1) :]
    log = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    before, heading, after = log.partition(_UNRELEASED)
    if not heading or not re.split(r"(?m)^## ", after)[0].strip():
        raise ReleaseError("CHANGELOG.md: found nothing below '## Unreleased'")
    changed["CHANGELOG.md"] = f"{before}{heading}\n## {version} - {today.isoformat()}\n{after}"
    return changed


def make(root: Path, version: str, changed: dict[str, str]) -> list[Path]:
    """Write the texts, build the wheels, then commit and tag.

    Raises:
        ReleaseError: the wheels cannot be built; the texts are as before, and there is no tag.
    """
    for name, text in changed.items():
        (root / name).write_text(text, encoding="utf-8")
    try:
        wheels = _build(root, version)
    except ReleaseError:
        _git(root, "checkout", "--", *changed)
        raise
    _git(root, "commit", "--quiet", "--message", f"Release {version}", *changed)
    _git(root, "tag", "--annotate", f"v{version}", "--message", f"DexTouch {version}")
    return wheels


def _build(root: Path, version: str) -> list[Path]:
    """Build both wheels, and write the SHA-256 of each beside it."""
    target = root / "dist"
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"]
    folders = [str(root), str(root / "weights")]
    done = subprocess.run([*words, str(target), *folders], check=False)  # noqa: S603 - own words
    wheels = sorted(target.glob(f"dextouch_wm*-{version}-*.whl"))
    names = [wheel.name.partition("-")[0] for wheel in wheels]
    if done.returncode or names != ["dextouch_wm", "dextouch_wm_weights"]:
        raise ReleaseError(
            f"{target}: pip ended with {done.returncode}, got {names or 'nothing'} of version "
            f"{version}, expected one wheel each of dextouch_wm and dextouch_wm_weights"
        )
    for wheel in wheels:
        digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
        wheel.with_suffix(".whl.sha256").write_text(f"{digest}  {wheel.name}\n", encoding="utf-8")
    return wheels


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(  # noqa: S603 - own words
        ["git", *words],  # noqa: S607
        cwd=root,
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
