"""Releases of a small checkout: version, changelog, tag, and what refuses one."""

import importlib.util
import subprocess
from datetime import date
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
_SPEC = importlib.util.spec_from_file_location("release", ROOT / "deploy/release.py")
release = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(release)

TODAY = date(2027, 1, 31)
LOG = "# Changelog\n\n## Unreleased\n\n### Added\n- A thing.\n\n## 0.1.0 - 2026-01-01\n- First.\n"


def git(folder, *words):
    names = ("-c", "user.name=Tester", "-c", "user.email=tester@example.com")
    subprocess.run(["git", *names, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "0.1.0"\nother = "0.1.0"\n')
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights/pyproject.toml").write_text('[project]\nversion = "0.1.0"\n')
    package = tmp_path / "shared/dextouch"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text('"""Doc."""\n\n__version__ = "0.1.0"\n')
    (tmp_path / "CHANGELOG.md").write_text(LOG)
    git(tmp_path, "init", "--quiet", "--initial-branch", "main")
    git(tmp_path, "add", "--all")
    git(tmp_path, "commit", "--quiet", "--message", "Begin")
    return tmp_path


def test_a_release_names_the_version_everywhere(checkout):
    changed = release.prepare(checkout, "0.2.0", TODAY)
    assert changed["pyproject.toml"] == '[project]\nversion = "0.2.0"\nother = "0.1.0"\n'
    assert changed["shared/dextouch/__init__.py"].endswith('__version__ = "0.2.0"\n')
    assert changed["CHANGELOG.md"] == (
        "# Changelog\n\n## Unreleased\n\n## 0.2.0 - 2027-01-31\n\n### Added\n- A thing.\n\n"
        "## 0.1.0 - 2026-01-01\n- First.\n"
    )


@pytest.mark.parametrize(
    ("version", "reason"),
    [
        ("0.1.0", "expected a version before"),
        ("0.0.9", "before"),
        ("new", "such as 0.2.0"),
        # Wheels are named by the normal form (PEP 440).
        ("v0.2.0", r"expected '0\.2\.0'"),
        ("0.2.0-rc.1", r"expected '0\.2\.0rc1'"),
        ("0.02.0", r"expected '0\.2\.0'"),
    ],
)
def test_only_newer_versions_are_released(checkout, version, reason):
    with pytest.raises(release.ReleaseError, match=reason):
        release.prepare(checkout, version, TODAY)


def test_what_is_not_committed_or_not_on_main_is_not_released(checkout):
    (checkout / "new.txt").write_text("x")
    with pytest.raises(release.ReleaseError, match=r"new\.txt"):
        release.prepare(checkout, "0.2.0", TODAY)
    (checkout / "new.txt").unlink()
    git(checkout, "tag", "v0.2.0")
    with pytest.raises(release.ReleaseError, match=r"tag v0\.2\.0 exists"):
        release.prepare(checkout, "0.2.0", TODAY)
    git(checkout, "switch", "--quiet", "--create", "side")
    with pytest.raises(release.ReleaseError, match="'side', expected main"):
        release.prepare(checkout, "0.3.0", TODAY)


def test_a_release_without_changes_is_refused(checkout):
    (checkout / "CHANGELOG.md").write_text("# Changelog\n\n## Unreleased\n\n## 0.1.0\n- First.\n")
    git(checkout, "commit", "--quiet", "--all", "--message", "Empty it")
    with pytest.raises(release.ReleaseError, match="nothing below"):
        release.prepare(checkout, "0.2.0", TODAY)


@pytest.fixture
def pip(checkout, monkeypatch):
    """Make pip write these wheels; the commands of git run as they are."""
    run = subprocess.run
    for name in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{name}_NAME", "Tester")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "tester@example.com")
    monkeypatch.chdir(checkout)
    monkeypatch.setattr("sys.argv", ["release.py", "0.2.0"])
    (checkout / ".git/info/exclude").write_text("/dist/\n")

    def give(*wheels, status=0):
        def instead(words, **options):
            if words[0] == "git":
                return run(words, **options)
            assert not run(["git", "tag"], capture_output=True, check=True).stdout
            (checkout / "dist").mkdir(exist_ok=True)
            for name in wheels:
                (checkout / "dist" / name).write_bytes(b"wheel")
            return subprocess.CompletedProcess(words, status)

        monkeypatch.setattr(release.subprocess, "run", instead)

    return give


CODE, WEIGHTS = (f"dextouch_wm{more}-0.2.0-py3-none-any.whl" for more in ("", "_weights"))


def test_both_wheels_are_built_before_the_tag(checkout, pip):
    pip(CODE, WEIGHTS, "dextouch_wm-0.1.0-py3-none-any.whl")
    assert release.main() == 0
    assert release._git(checkout, "tag", "--points-at", "HEAD") == "v0.2.0"
    assert 'version = "0.2.0"' in release._git(checkout, "show", "HEAD:weights/pyproject.toml")
    hashed = sorted(path.name for path in checkout.glob("dist/*.sha256"))
    assert hashed == [f"{CODE}.sha256", f"{WEIGHTS}.sha256"]


@pytest.mark.parametrize(
    ("wheels", "status"),
    [
        ((CODE,), 0),
        ((), 0),
        ((CODE, WEIGHTS), 1),
        ((CODE, CODE.replace("any", "linux"), WEIGHTS), 0),
    ],
)
def test_without_both_wheels_there_is_no_release(checkout, pip, capsys, wheels, status):
    pip(*wheels, status=status)
    assert release.main() == 1
    assert "expected one wheel each of dextouch_wm and" in capsys.readouterr().err
    assert release._git(checkout, "tag") == release._git(checkout, "status", "--porcelain") == ""
    assert release._git(checkout, "log", "--format=%s") == "Begin"


def test_package_and_distribution_have_one_version():
    found = {
        name: release.re.search(pattern, (ROOT / name).read_text())[1]
        for name, pattern in release._PLACES
    }
    assert len(set(found.values())) == 1, found
