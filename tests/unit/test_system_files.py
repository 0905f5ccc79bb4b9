"""What operating systems leave in folders is neither data nor damage where folders are listed."""

import numpy as np
import pytest

from dextouch.data_folder import is_system_file
from dextouch.episodes import EpisodeStore
from services.alignment.station_calibration.boards import photo_paths
from services.cli import main
from tests.unit.bridges.takes import write_episode, write_recording

LEFT = ("._zarr.json", ".DS_Store", "Thumbs.db", "desktop.ini")


@pytest.mark.parametrize(
    "path",
    ["._take.mcap", ".DS_Store", "a/.DS_Store", "__MACOSX/a/b.json", "Thumbs.db", "THUMBS.DB",
     "desktop.ini", ".Trashes/x", "System Volume Information", ".nfs000000000012"],
)  # fmt: skip
def test_files_of_systems(path):
    assert is_system_file(path)


@pytest.mark.parametrize("path", ["a._b", "zarr.json", "DS_Store", "c/0/0/0", "notes.txt", ".x"])
def test_other_files(path):
    assert not is_system_file(path)


def leave_in(folder):
    for name in LEFT:
        (folder / name).write_bytes(b"\0\5\x16\7" + bytes(60))


def test_a_store_with_them_is_whole(tmp_path, capsys):
    store = EpisodeStore(tmp_path / "store")
    write_episode(store)
    write_recording(store, count=5)
    folders = [path for path in (tmp_path / "store").rglob("*") if path.is_dir()]
    for folder in (tmp_path / "store", *folders):
        leave_in(folder)
    for name in (".uploads", ".staging", ".trash"):
        (tmp_path / "store" / name).mkdir(exist_ok=True)
        leave_in(tmp_path / "store" / name)
    for words in (("verify",), ("list",), ("repair",)):
        assert main.main(["store", *words, "--store", str(tmp_path / "store")]) == 0
    assert "damaged" not in capsys.readouterr().out.lower()
    # Anything else is still named.
    (tmp_path / "store/episodes/stand-bottle-0003/mine.txt").write_text("x")
    assert main.main(["store", "verify", "--store", str(tmp_path / "store")]) != 0


def test_imports_and_photos_pass_over_them(tmp_path, capsys):
    store = EpisodeStore(tmp_path / "store")
    write_episode(store, num_steps=3)
    common = ("--store", str(tmp_path / "store"))
    takes, dataset = tmp_path / "takes", tmp_path / "dataset"
    assert main.main(["export", "--format", "mcap", "--to", str(takes), *common]) == 0
    assert main.main(["export", "--format", "lerobot", "--to", str(dataset), *common]) == 0
    (takes / "._stand-bottle-0003.mcap").write_bytes(bytes(70))
    for folder in [dataset, *(path for path in dataset.rglob("*") if path.is_dir())]:
        leave_in(folder)
        for file in list(folder.glob("*.parquet")):
            (folder / f"._{file.name}").write_bytes(bytes(70))
    for form, path in (("mcap", takes), ("lerobot", dataset)):
        words = ["import", "--format", form, str(path), "--store", str(tmp_path / form)]
        assert main.main(words) == 0, capsys.readouterr().err
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("b.png", "a.jpg", "._a.jpg", "._b.png", "Thumbs.db"):
        (photos / name).write_bytes(b"x")
    assert [path.name for path in photo_paths(photos)] == ["a.jpg", "b.png"]


def test_a_photo_is_read_as_its_sensor_delivered_it(tmp_path):
    """As a camera bridge's JPEG is recorded: EXIF orientation turns neither."""
    from PIL import Image

    from dextouch.images import decode_jpeg
    from services.alignment.station_calibration.boards import decode_photo

    picture = Image.fromarray(np.tile(np.arange(48, dtype=np.uint8) * 5, (32, 1)))
    exif = Image.Exif()
    exif[0x0112] = 6  # turned by 90 degrees
    picture.convert("RGB").save(tmp_path / "turned.jpg", exif=exif)
    data = (tmp_path / "turned.jpg").read_bytes()
    photo = decode_photo(data, where="photo")
    assert photo.shape == (32, 48)
    assert np.abs(photo.astype(int) - decode_jpeg(data)[..., 0]).max() <= 2
