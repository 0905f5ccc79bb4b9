"""How this package was installed, and the command that adds an extra to that installation.

Needed wherever a missing package is reported: `pip install 'dextouch-wm[…]'` only works where the
package came from an index.
"""

import json
import os
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

if TYPE_CHECKING:
    from importlib.metadata import Distribution

NAME = "dextouch-wm"
# The wheel of the models' weights, which is no part of the package's own.
WEIGHTS = f"{NAME}-weights"


def install_command(extra: str) -> str:
    """Shell command that adds an extra to this installation, by the way in which it was made.

    The installer's record (PEP 610, direct_url.json) tells of a checkout, a wheel file or a
    repository; without one the package came from an index. Of a wheel file that is gone, the
    command names the packages of the extra. Weights, which extras with networks need, are taken
    from the same place. Without an installation, as with PYTHONPATH, it is that of the checkout.
    """
    installed = _installed()
    if installed is None:
        return pip_install("-e", f"{Path(__file__).parents[2]}[{extra}]")
    record = installed.read_text("direct_url.json")
    origin: dict[str, Any] | None = None if record is None else json.loads(record)
    return pip_install(*_arguments(installed, origin, extra))


def pip_install(*arguments: str) -> str:
    """Shell command that installs into this environment, by pip or uv, whichever installed us.

    It names this Python where another environment is active.
    """
    installed = _installed()
    installer = (installed and installed.read_text("INSTALLER")) or ""
    if installer.strip() == "uv":
        is_active = os.environ.get("VIRTUAL_ENV", "") == sys.prefix
        start = ["uv", "pip", "install", *([] if is_active else ["--python", sys.executable])]
    else:
        found = shutil.which("pip")
        is_active = found is not None and Path(found).parent == Path(sys.executable).parent
        start = ["pip", "install"] if is_active else [sys.executable, "-m", "pip", "install"]
    return shlex.join([*start, *arguments])


def _installed() -> "Distribution | None":
    from importlib import metadata  # of a cost that most commands can do without

    try:
        return metadata.distribution(NAME)
    except metadata.PackageNotFoundError:
        return None


def _arguments(installed: "Distribution", origin: dict[str, Any] | None, extra: str) -> list[str]:
    """Arguments of `pip install`."""
    requirement = f"{NAME}[{extra}]"
    if origin is None:
        return [requirement]
    url: str = origin["url"]
    packages = _packages_of(installed, extra)
    others = [package for package in packages if not package.startswith(WEIGHTS)]
    needs_weights = len(others) < len(packages)
    if "dir_info" in origin:
        folder = _path_of(url)
        if origin["dir_info"].get("editable"):
            return ["-e", f"{folder}[{extra}]"]
        return [*([str(folder / "weights")] if needs_weights else []), f"{folder}[{extra}]"]
    if "vcs_info" in origin:
        vcs = origin["vcs_info"]
        url = f"{vcs['vcs']}+{url}@{vcs['commit_id']}"
    weights = [f"{WEIGHTS} @ {_weights_beside(url)}"] if needs_weights else []
    if not url.startswith("file:") or _path_of(url).is_file():
        return [*weights, f"{requirement} @ {url}"]
    return [*weights, *others] or [requirement]


def _weights_beside(url: str) -> str:
    """Where the weights are: the wheel beside that of the code, or a folder of its repository."""
    place, slash, name = url.partition("?")[0].rpartition("/")
    if not name.endswith(".whl"):
        return f"{url}#subdirectory=weights"
    own, dash, rest = name.partition("-")
    return f"{place}{slash}{own}_weights{dash}{rest}"


def _packages_of(installed: "Distribution", extra: str) -> list[str]:
    """The requirements of an extra, without markers."""
    named = re.compile(rf"""extra\s*==\s*["']{re.escape(extra)}["']""")
    pairs = (line.partition(";") for line in installed.requires or ())
    return [package.strip() for package, _, marker in pairs if named.search(marker)]


def _path_of(url: str) -> Path:
    return Path(unquote(urlsplit(url).path))
