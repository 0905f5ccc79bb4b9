"""kill -9 of an edit at any file that it touches: the source counts, or the result, never both."""

import os
import random
import shutil
import signal
import sys

import pytest

from dextouch.episodes import EpisodeStore, maintenance, select_episodes
from dextouch.episodes.editing import (
    EditOptions,
    MergeOptions,
    merge_stores,
    relabel_item,
    trim_episode,
)
from tests.unit.episode_store.episodes import write_episode

pytestmark = pytest.mark.system
# Each changes, creates or renames something.
EVENTS = {"open", "os.mkdir", "os.rename", "os.link", "os.remove", "os.truncate"}


def trim(root):
    trim_episode(EpisodeStore(root), "a", (2, 20), options=EditOptions(new_id="b"))


def relabel(root):
    relabel_item(EpisodeStore(root), "a", {"instruction": "up"}, options=EditOptions(new_id="b"))


def merge(root):
    merge_stores([EpisodeStore(root / "b")], EpisodeStore(root), options=MergeOptions())


def killed_at(place, edit, root):
    """Run an edit in a child that dies at its n-th file event; how many events there were."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        count = 0

        def count_event(event, args):
            nonlocal count
            if event in EVENTS and str(root) in str(args):
                os.write(write, b".")
                if count == place:
                    os.kill(os.getpid(), signal.SIGKILL)
                count += 1

        status = 1
        try:
            sys.addaudithook(count_event)
            edit(root)
            status = 0
        finally:
            os._exit(status)
    os.close(write)
    with os.fdopen(read, "rb") as events:
        total = len(events.read())
    _, status = os.waitpid(pid, 0)
    assert status in {0, signal.SIGKILL}
    assert (status == 0) == (place < 0 or total <= place)
    return total


def check(edit, folder, places):
    store = EpisodeStore(folder / "before")
    write_episode(store, "a", num_steps=20)
    if edit is merge:
        write_episode(EpisodeStore(store.root / "b"), "b", num_steps=20)
    shutil.copytree(store.root, folder / "whole")
    total = killed_at(-1, edit, folder / "whole")
    assert total > 10
    found = set()
    for place in places(total):
        root = folder / str(place)
        shutil.copytree(store.root, root)
        killed_at(place, edit, root)
        ours = EpisodeStore(root)
        ours.sweep()
        assert list((root / ".staging").glob("*")) == []
        chosen = tuple(reader.item_id for reader in select_episodes([ours]))
        found.add(chosen)
        assert chosen in {("a",), ("a", "b")} if edit is merge else {("a",), ("b",)}
        for name in ours.list():
            assert not maintenance.inspect_group(ours.files(name), "episode").damaged
        # Repeated, it is done.
        if ours.exists("a"):
            edit(root)
        assert ours.open("b").verify()
        shutil.rmtree(root)
    return found


@pytest.mark.parametrize("edit", [trim, relabel, merge])
def test_a_killed_edit_leaves_one_of_both(edit, tmp_path):
    def few(total):
        middle = random.Random(4).sample(range(1, total - 1), 3)
        return [0, *middle, total - 2, total - 1]

    assert len(check(edit, tmp_path, few)) == 2


@pytest.mark.slow
@pytest.mark.parametrize("edit", [trim, relabel, merge])
def test_an_edit_killed_at_every_file(edit, tmp_path):
    assert len(check(edit, tmp_path, range)) == 2
