"""Where compiled code is kept, and that the image's user runs what the image holds."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from services.alignment.retargeting.solver import folder_of_code

CHECKOUT = Path(__file__).parents[3]
DOCKERFILE = CHECKOUT / "deploy" / "Dockerfile"
IMAGE_UID = 10001
# Another user may not reach the interpreter's own modules: they are all loaded before. What is ours
# is then imported again, as that user.
AS_USER = """
import json, os, sys
import numba
import services.alignment.retargeting

numba.njit(lambda a: a + 1.0)(1.0)
uid = int(sys.argv[1])
os.setgroups([])
os.setgid(uid)
os.setuid(uid)
numba.config.CACHE_DIR = sys.argv[2]
for name in [name for name in sys.modules if name.startswith("services.")]:
    del sys.modules[name]
"""
# A function that is compiled and kept like the solver, in a moment instead of half a minute.
SMALL = """
from services.alignment.retargeting import solver

@solver.compiled_once
def add(a, b):
    return a + b

print(json.dumps({
    "total": add(1.5, 2.0),
    "folder": solver._FOLDER and str(solver._FOLDER),
    "is_loaded": bool(add.stats.cache_hits),
}))
"""
SOLVER = """
from services.alignment.retargeting import warm_up
from services.alignment.retargeting.solver.solve import retarget_samples
warm_up()
print(json.dumps({"is_loaded": bool(retarget_samples.stats.cache_hits)}))
"""


@pytest.mark.parametrize("umask", [0o002, 0o022, 0o077])
def test_folder_by_the_content_of_the_code_is_of_this_user_alone(tmp_path, umask):
    before = os.umask(umask)
    try:
        folder, again = [folder_of_code(tmp_path / "new" / "base") for _ in range(2)]
    finally:
        os.umask(before)
    assert folder == again
    assert folder.parent == tmp_path / "new" / "base"
    assert len(folder.name) == 16
    # What numba makes inside has the modes of the umask: others must not get there.
    assert folder.stat().st_mode & 0o777 == 0o700
    assert folder.parent.stat().st_mode & 0o022 == 0


@pytest.mark.parametrize("mode", [0o770, 0o755, 0o707])
def test_no_folder_that_others_may_enter_is_used(tmp_path, mode):
    folder = folder_of_code(tmp_path / "base")
    folder.chmod(mode)
    assert folder_of_code(tmp_path / "base") is None


@pytest.mark.parametrize("mode", [0o775, 0o757])
def test_no_folder_that_others_may_replace_is_used(tmp_path, mode):
    folder_of_code(tmp_path / "base").parent.chmod(mode)
    assert folder_of_code(tmp_path / "base") is None


def test_a_link_that_is_turned_later_changes_nothing(tmp_path):
    (tmp_path / "real").mkdir(mode=0o755)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    folder = folder_of_code(tmp_path / "link")
    assert folder.parent == tmp_path / "real"
    # In a folder for temporary files anybody may make a link of this name.
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert folder_of_code(tmp_path / "link") is None


def test_a_folder_for_temporary_files_may_be_named(tmp_path):
    (tmp_path / "base").mkdir()
    (tmp_path / "base").chmod(0o1777)
    assert folder_of_code(tmp_path / "base").parent == tmp_path / "base"


def test_nowhere_to_write(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    assert folder_of_code(tmp_path / "file" / "a") is None
    assert folder_of_code(tmp_path / "base") is not None
    # On a disk that is mounted read-only.
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert folder_of_code(tmp_path / "base") is None


def test_the_folder_of_somebody_else_is_not_run(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    assert folder_of_code(tmp_path / "base") is None


@pytest.fixture(scope="module")
def image():
    """A folder that every user can reach, unlike those of pytest."""
    if os.getuid() != 0:
        pytest.skip("only root can run a process as another user")
    base = Path(tempfile.mkdtemp(prefix="dextouch-image-"))
    base.chmod(0o755)
    yield base
    shutil.rmtree(base)


def run_as(uid, script, image, base):
    """What a script prints as that user, without a home; and what is logged."""
    path = image / "script.py"
    path.write_text(AS_USER + script)
    done = subprocess.run(
        [sys.executable, str(path), str(uid), str(base)],
        cwd="/",
        env={
            "PYTHONPATH": f"{CHECKOUT}{os.pathsep}{CHECKOUT / 'shared'}",
            "PYTHONDONTWRITEBYTECODE": "1",
            # Of what is imported as root.
            "NUMBA_CACHE_DIR": str(image / "root"),
            "HOME": "/nonexistent",
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


def start_container(image):
    """Run the entry command of the image as its user; returns the folder that it copies code to."""
    (line,) = re.findall(r"^ENTRYPOINT (.*)$", DOCKERFILE.read_text(), re.MULTILINE)
    temporary = image / "tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(mode=0o700)
    os.chown(temporary, IMAGE_UID, IMAGE_UID)
    entry = [word.replace("/opt/code", str(image)) for word in json.loads(line)]
    # Twice, as where a container is started again.
    for _ in range(2):
        done = subprocess.run(
            [*entry, "sh", "-c", "umask; echo $1", "a", "two words"],
            user=IMAGE_UID,
            group=IMAGE_UID,
            extra_groups=[],
            umask=0o022,
            env={"PATH": os.environ["PATH"], "NUMBA_CACHE_DIR": str(temporary / "compiled")},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout == "0022\ntwo words\n"
    return temporary / "compiled", done.stderr


def build(image, script):
    """Compile as root, and make the code readable, as the image does."""
    shutil.rmtree(image / "compiled", ignore_errors=True)
    built, _ = run_as(0, script, image, image / "compiled")
    assert not built["is_loaded"]
    for path in [image / "compiled", *(image / "compiled").rglob("*")]:
        path.chmod(path.stat().st_mode | (0o055 if path.is_dir() else 0o044))


@pytest.mark.slow
def test_code_that_root_compiled_is_run_by_the_images_user(image):
    build(image, SMALL)
    base, told = start_container(image)
    assert told == ""
    found, logged = run_as(IMAGE_UID, SMALL, image, base)
    assert found["total"] == 3.5
    assert Path(found["folder"]).parent == base
    assert found["is_loaded"]
    assert "compiled_code" not in logged


@pytest.mark.slow
def test_an_image_without_code_starts_and_compiles(image):
    shutil.rmtree(image / "compiled", ignore_errors=True)
    base, told = start_container(image)
    assert "compiled" in told
    found, _ = run_as(IMAGE_UID, SMALL, image, base)
    assert found["total"] == 3.5
    assert not found["is_loaded"]


@pytest.mark.slow
def test_without_any_folder_code_is_compiled_in_memory(image):
    found, logged = run_as(IMAGE_UID, SMALL, image, "/proc/nowhere")
    assert found == {"total": 3.5, "folder": None, "is_loaded": False}
    assert "compiled_code_not_kept" in logged
    assert "NUMBA_CACHE_DIR" in logged


@pytest.mark.slow
def test_the_solver_that_root_compiled_is_run_by_the_images_user(image):
    build(image, SOLVER)
    base, _ = start_container(image)
    found, _ = run_as(IMAGE_UID, SOLVER, image, base)
    assert found == {"is_loaded": True}
