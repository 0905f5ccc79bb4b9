"""Where compiled code is kept, what of it is brought along, and that another user may run it."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from services.alignment.retargeting.solver.compiled import folder_of_code

CHECKOUT = Path(__file__).parents[3]
# Of deploy/Dockerfile.
IMAGE_UID = 10001
# Another user may not reach the interpreter's own modules: they are all loaded before. What is ours
# is then imported again, as that user.
AS_USER = """
import json, os, sys, tempfile
import numba
import services.alignment.retargeting

numba.njit(lambda a: a + 1.0)(1.0)
uid, place = int(sys.argv[1]), sys.argv[2]
os.setgroups([])
os.setgid(uid)
os.setuid(uid)
numba.config.CACHE_DIR = sys.argv[3]
if place == "nowhere":
    tempfile.tempdir = "/proc/nowhere"
for name in [name for name in sys.modules if name.startswith("services.")]:
    del sys.modules[name]
"""
# A function that is compiled and kept like the solver, in a moment instead of half a minute.
SMALL = """
from services.alignment.retargeting.solver import compiled

@compiled.compiled_once
def add(a, b):
    return a + b

print(json.dumps({
    "total": add(1.5, 2.0),
    "folder": compiled._FOLDER and str(compiled._FOLDER),
    "is_loaded": bool(add.stats.cache_hits),
}))
"""
SOLVER = """
from services.alignment.retargeting import warm_up
from services.alignment.retargeting.solver.solve import retarget_samples
warm_up()
print(json.dumps({"is_loaded": bool(retarget_samples.stats.cache_hits)}))
"""


def test_the_first_folder_by_the_content_of_the_code(tmp_path):
    before = os.umask(0o022)
    folder = folder_of_code(tmp_path / "wanted", tmp_path / "spare")
    os.umask(before)
    assert folder.parent == tmp_path / "wanted"
    assert len(folder.name) == 16
    assert folder_of_code(tmp_path / "wanted", tmp_path / "spare") == folder
    # What it holds is run: others may read, not write.
    assert folder.stat().st_mode & 0o777 == 0o755


def test_read_only_code_is_copied(tmp_path, monkeypatch):
    name = folder_of_code(tmp_path / "wanted", tmp_path / "spare").name
    (tmp_path / "wanted" / name / "deep").mkdir()
    (tmp_path / "wanted" / name / "deep" / "solver.nbi").write_bytes(b"code")
    (tmp_path / "wanted" / name / "deep").chmod(0o555)
    monkeypatch.setattr(os, "access", lambda path, _: tmp_path / "wanted" not in path.parents)
    folder = folder_of_code(tmp_path / "wanted", tmp_path / "spare")
    assert folder == tmp_path / "spare" / name
    assert (folder / "deep" / "solver.nbi").read_bytes() == b"code"
    assert folder.stat().st_mode & 0o700 == 0o700
    assert (folder / "deep").stat().st_mode & 0o700 == 0o700


def test_code_that_others_may_write_is_not_taken(tmp_path, monkeypatch):
    name = folder_of_code(tmp_path / "wanted", tmp_path / "spare").name
    (tmp_path / "wanted" / name / "solver.nbi").write_bytes(b"code")
    (tmp_path / "wanted" / name).chmod(0o777)
    monkeypatch.setattr(os, "access", lambda path, _: tmp_path / "wanted" not in path.parents)
    folder = folder_of_code(tmp_path / "wanted", tmp_path / "spare")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("umask", [0o002, 0o022, 0o077])
def test_folders_of_every_umask_are_used_again(tmp_path, umask):
    before = os.umask(umask)
    try:
        found = [folder_of_code(tmp_path / "new" / "wanted", tmp_path / "spare") for _ in range(2)]
    finally:
        os.umask(before)
    assert [folder.parent for folder in found] == [tmp_path / "new" / "wanted"] * 2
    for made in (found[0], found[0].parent):
        assert made.stat().st_mode & 0o022 == 0
    # What numba makes inside has the modes of the umask: others must not get there.
    is_open = umask & 0o022 != 0o022
    assert found[0].stat().st_mode & 0o077 == 0 or not is_open


@pytest.mark.parametrize("mode", [0o775, 0o757])
def test_no_folder_that_others_may_write_is_used(tmp_path, mode):
    wanted, spare = tmp_path / "wanted", tmp_path / "spare"
    wanted.mkdir()
    wanted.chmod(mode)
    assert folder_of_code(wanted, spare).parent == spare
    wanted.chmod(0o755)
    folder = folder_of_code(wanted, spare)
    assert folder.parent == wanted
    folder.chmod(mode)
    assert folder_of_code(wanted, spare).parent == spare


def test_a_link_that_is_turned_later_changes_nothing(tmp_path):
    (tmp_path / "real").mkdir(mode=0o755)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    folder = folder_of_code(tmp_path / "link", tmp_path / "spare")
    assert folder.parent == tmp_path / "real"
    # In a folder for temporary files anybody may make a link of this name.
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert folder_of_code(tmp_path / "link", tmp_path / "spare").parent == tmp_path / "spare"


def test_code_below_a_folder_that_others_may_write_is_not_copied(tmp_path, monkeypatch):
    name = folder_of_code(tmp_path / "wanted", tmp_path / "spare").name
    (tmp_path / "wanted" / name / "solver.nbi").write_bytes(b"code")
    (tmp_path / "wanted").chmod(0o777)
    monkeypatch.setattr(os, "access", lambda path, _: tmp_path / "wanted" not in path.parents)
    folder = folder_of_code(tmp_path / "wanted", tmp_path / "spare")
    assert list(folder.iterdir()) == []


def test_a_folder_for_temporary_files_may_be_named(tmp_path):
    (tmp_path / "wanted").mkdir()
    (tmp_path / "wanted").chmod(0o1777)
    assert folder_of_code(tmp_path / "wanted", tmp_path / "spare").parent == tmp_path / "wanted"
    # Where others could put a folder of their own in its place.
    (tmp_path / "wanted").chmod(0o777)
    assert folder_of_code(tmp_path / "wanted", tmp_path / "spare").parent == tmp_path / "spare"


def test_nowhere_to_write(tmp_path):
    (tmp_path / "file").write_text("")
    assert folder_of_code(tmp_path / "file" / "a", tmp_path / "file" / "b") is None


def test_the_folder_of_somebody_else_is_not_run(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    assert folder_of_code(tmp_path / "wanted", tmp_path / "spare") is None


@pytest.fixture(scope="module")
def image():
    """A folder that every user can reach, unlike those of pytest."""
    if os.getuid() != 0:
        pytest.skip("only root can run a process as another user")
    base = Path(tempfile.mkdtemp(prefix="dextouch-image-"))
    base.chmod(0o755)
    yield base
    shutil.rmtree(base)


def run_as(uid, script, image, place="temporary"):
    """What a script prints as that user, without a home; and what is logged."""
    path = image / "script.py"
    path.write_text(AS_USER + script)
    # numba keeps the time of the file with its code.
    os.utime(path, (1, 1))
    temporary = image / f"tmp-{uid}"
    if not temporary.is_dir():
        temporary.mkdir(mode=0o700)
        os.chown(temporary, uid, uid)
    done = subprocess.run(
        [sys.executable, str(path), str(uid), place, str(image / "compiled")],
        cwd="/",
        env={
            "PYTHONPATH": f"{CHECKOUT}{os.pathsep}{CHECKOUT / 'shared'}",
            "PYTHONDONTWRITEBYTECODE": "1",
            # Of what is imported as root.
            "NUMBA_CACHE_DIR": str(image / "root"),
            "HOME": "/nonexistent",
            "TMPDIR": str(temporary),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    if "No module named 'services" in done.stderr:
        pytest.skip("other users cannot read this checkout")
    assert done.returncode == 0, done.stderr
    *logged, answer = done.stdout.splitlines()
    return json.loads(answer), "\n".join(logged) + done.stderr


@pytest.fixture(scope="module")
def built(image):
    """The folder of the code that root compiled."""
    found, _ = run_as(0, SMALL, image)
    assert not found["is_loaded"]
    return Path(found["folder"])


def test_code_that_root_compiled_is_run_by_the_images_user(image, built):
    found, logged = run_as(IMAGE_UID, SMALL, image)
    assert found["total"] == 3.5
    assert found["folder"] == str(image / f"tmp-{IMAGE_UID}" / f"dextouch-{IMAGE_UID}" / built.name)
    assert found["is_loaded"]
    assert "compiled_code" not in logged


def test_code_that_may_not_be_read_is_compiled_again(image, built):
    built.chmod(0o700)
    shutil.rmtree(image / f"tmp-{IMAGE_UID}", ignore_errors=True)
    found, logged = run_as(IMAGE_UID, SMALL, image)
    built.chmod(0o755)
    assert found["total"] == 3.5
    assert not found["is_loaded"]
    assert "compiled_code_not_copied" in logged


def test_without_any_folder_code_is_compiled_in_memory(image, built):
    assert built.is_dir()
    found, logged = run_as(IMAGE_UID, SMALL, image, "nowhere")
    assert found == {"total": 3.5, "folder": None, "is_loaded": False}
    assert "compiled_code_not_kept" in logged
    assert "NUMBA_CACHE_DIR" in logged


@pytest.mark.slow
def test_the_solver_that_root_compiled_is_run_by_the_images_user(image):
    shutil.rmtree(image / "compiled", ignore_errors=True)
    shutil.rmtree(image / f"tmp-{IMAGE_UID}", ignore_errors=True)
    built, _ = run_as(0, SOLVER, image)
    assert built == {"is_loaded": False}
    found, _ = run_as(IMAGE_UID, SOLVER, image)
    assert found == {"is_loaded": True}
