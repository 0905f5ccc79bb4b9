"""Where compiled code is kept, and what of it is brought along."""

import os

from services.alignment.retargeting.solver.compiled import folder_of_code


def test_the_wanted_folder_by_the_content_of_the_code(tmp_path):
    folder = folder_of_code(tmp_path / "wanted", tmp_path / "spare")
    assert folder.parent == tmp_path / "wanted"
    assert len(folder.name) == 16
    assert folder_of_code(tmp_path / "wanted", tmp_path / "spare") == folder
    assert folder.stat().st_mode & 0o077 == 0


def test_read_only_code_is_copied(tmp_path, monkeypatch):
    name = folder_of_code(tmp_path / "wanted", tmp_path / "spare").name
    (tmp_path / "wanted" / name / "solver.nbi").write_bytes(b"code")
    monkeypatch.setattr(os, "access", lambda path, _: tmp_path / "wanted" not in path.parents)
    folder = folder_of_code(tmp_path / "wanted", tmp_path / "spare")
    assert folder == tmp_path / "spare" / name
    assert (folder / "solver.nbi").read_bytes() == b"code"


def test_nowhere_to_write(tmp_path):
    (tmp_path / "file").write_text("")
    assert folder_of_code(tmp_path / "file" / "a", tmp_path / "file" / "b") is None


def test_the_folder_of_somebody_else_is_not_run(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    assert folder_of_code(tmp_path / "wanted", tmp_path / "spare") is None
