"""How many places data passes through on its way, and that nothing is done twice there.

Bounds are what was measured when they were written: a walk may become shorter.
"""

import sys

import pytest

from benchmarks import walks
from dextouch.episodes import EpisodeStore
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld
from services.world_model.world import open_world
from tests.unit.bridges.takes import write_episode

NUM_PACKETS = round(60 * walks.TAKE_S)


@pytest.fixture(scope="module")
def chunk():
    return walks.action_chunk_walk()


WORLDS = {
    "copy-first": lambda: None,
    "twin": lambda: TwinWorld(TwinSettings(cameras=())),
    "state": open_world,
}


@pytest.mark.parametrize("name", WORLDS)
def test_actions_are_checked_once_on_each_side_of_http(name, chunk):
    walk = chunk if name == "copy-first" else walks.action_chunk_walk(WORLDS[name]())
    assert walk.name == f"action chunk, {name}"
    assert walk.num_calls("check_actions", threads="MainThread") == walks.NUM_CHUNKS
    # A world that is quick is called in the service's event loop.
    threads = "services" if name == "copy-first" else "world-"
    assert walk.num_calls("check_actions", threads=threads) == walks.NUM_CHUNKS
    assert walk.num_calls("check_actions") == 2 * walks.NUM_CHUNKS


def test_an_action_chunk_passes_through_few_files(chunk):
    # Two of them pass the trace context on, in client and service; one holds the service's keys.
    assert len(chunk.files) <= 19, chunk.files


def test_a_glove_packet_is_checked_counted_and_encoded_once():
    walk = walks.packet_to_spool("tactile_left")
    once = ("PacketDecoder._take", "check_batch", "encode_body", "SpoolLogWriter.append")
    assert {name: walk.num_calls(name) for name in once} == dict.fromkeys(once, NUM_PACKETS)
    assert walk.num_calls("DeviceSupervisor.count") == NUM_PACKETS
    assert len(walk.files) <= 22, walk.files


def test_an_image_passes_through_few_files():
    walk = walks.WALKS["image"]()
    assert walk.num_calls("PacketDecoder._take") == round(30 * walks.TAKE_S)
    assert len(walk.files) <= 22, walk.files


def test_an_upload_encodes_no_sample_again_and_the_store_checks_it_once():
    walk = walks.upload()
    # 120 samples are one batch, whose bytes are those of the station's spool.
    once = ("frame_body", "read_batch", "check_batch", "SpoolLogWriter.append")
    assert {name: walk.num_calls(name) for name in once} == dict.fromkeys(once, 1)
    # The store checks the batch, and the station makes the digest that proves the upload.
    assert walk.num_calls("decode_body") == 2
    assert walk.num_calls("check_batch", threads="MainThread") == 0
    assert walk.num_calls("encode_body") == 0
    # Two of them pass the trace context on, in uploader and store; one holds the store's keys. One
    # each for whose the upload is, the digest and the seal of the spool; five open what was
    # committed, since its commit record is the proof; three list the spool with its retention, and
    # refuse what was deleted by the store's records of that; three look whether the folder is still
    # there, at the texts of a new take, and at wrong keys.
    assert len(walk.files) <= 35, walk.files


def test_the_clock_is_one_package():
    walk = walks.clock_stamp()
    assert {file.rsplit("/", 1)[0] for file in walk.files} == {"dextouch/clocks"}
    assert len(walk.files) <= 5, walk.files


def test_a_window_passes_through_few_files(tmp_path):
    write_episode(EpisodeStore(tmp_path), num_steps=21)
    walk = walks.window_into_training(str(tmp_path))
    assert walk.num_calls("_Episode.cut") == 1
    assert len(walk.files) <= 23, walk.files


def test_tracing_ends_with_the_walk(chunk):
    assert chunk.calls
    assert sys.getprofile() is None


def test_the_command_prints_a_row(capsys):
    assert walks.main(["--only", "clock"]) == 0
    assert "clock stamp" in capsys.readouterr().out
