"""The list of tasks: the twin's by default, a file's where one is set, and what is refused."""

import pytest

from dextouch.errors import InvalidInputError
from services.dashboard.pages import load_tasks
from services.twin.names import TASK_NAMES
from services.twin.tasks import get_task


def test_the_default_tasks_are_those_of_the_twin():
    listed = {task.name: task.instructions for task in load_tasks(None)}
    assert listed == {name: (get_task(name).instruction,) for name in TASK_NAMES}


def test_a_file_replaces_them(tmp_path):
    path = tmp_path / "tasks.toml"
    path.write_text(
        '[[tasks]]\nname = "wipe"\ninstructions = ["Wipe.", "Dry."]\ngoal = 3\nreset_s = 2.5\n'
    )
    (task,) = load_tasks(path)
    assert (task.name, task.instructions, task.goal) == ("wipe", ("Wipe.", "Dry."), 3)
    assert task.reset_s == 2.5


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("tasks = [", "cannot be read"),
        ("", "tasks"),
        ('[[tasks]]\nname = "a"\n', "instructions"),
        ('[[tasks]]\nname = "a"\ninstructions = ["b"]\ncolour = 1\n', "colour"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path, text, why):
    path = tmp_path / "tasks.toml"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=rf"task file .*tasks.toml.*{why}"):
        load_tasks(path)
    with pytest.raises(InvalidInputError, match="cannot be read"):
        load_tasks(tmp_path / "absent.toml")
