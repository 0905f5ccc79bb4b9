"""Characters that change how text is shown: refused from people, readable and escaped if stored."""

import json
import unicodedata
from datetime import UTC, datetime

import numpy as np
import pytest
import structlog
from httpx import ASGITransport, AsyncClient
from pydantic import TypeAdapter, ValidationError

from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.free_text import FreeLines, FreeText, check_line, printable
from dextouch.schemas import (
    NewRecording,
    RecordingAttributes,
    ReviewItems,
    StartRequest,
    TakePrompt,
)
from dextouch.serving import configure_logging
from dextouch.streams import StreamDescriptor
from services.acquisition.settings import AcquisitionSettings
from services.alignment.station_calibration.runs import Answer, RunRequest
from services.cli.main import main
from services.cli.up_settings import UpSettings
from services.dashboard.pages import load_tasks
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings
from services.evaluation.rating.app import SubmittedMark
from services.evaluation.rating.rubrics import Criterion

# Clears a screen, forges a line, turns the reading order, hides.
BAD = [
    *("\x1b[2J", "\x00", "\x07", "\r", "\x7f", "\x9b2J", "\x85"),
    *("\u202e", "\u202a", "\u2066", "\u2069", "\u200e", "\u200f", "\u061c"),
    *("\u2028", "\u2029", "\u200b", "\u2060", "\ufeff", "\U000e0041"),
]
# Words that people write: German, Persian with a joiner, Hindi, Arabic, Chinese, a joined emoji.
# ruff: noqa: RUF001
GOOD = [
    "Flasche stellen – übung",
    "می\u200cخواهم",
    "क्\u200dष",
    "ضع الزجاجة",
    "把瓶子立起来",
    "👩\u200d🔧",
]
PROMPT = {"task": "stand", "instruction": "stand it up"}
ITEM = {"items": [{"kind": "recording", "id": "a"}], "verdict": "rejected"}
START = {"world": "twin", "task": "stand", "seed": 1, "instruction": "stand it up"}
ROLLOUT = "0" * 20
MARK = {"rater": "ada", "cannot_judge": True, "rollout": ROLLOUT}
TAKE = {
    "recording_id": "take-1",
    "task": "stand",
    "instruction": "stand it up",
    "domain": "human",
    "station": "desk",
}
STREAM = {
    "name": "head",
    "kind": "pose",
    "shape": (7,),
    "dtype": "float64",
    "unit": "pose_m_wxyz",
    "nominal_rate_hz": 100.0,
}
FIELDS = [
    *((TakePrompt, PROMPT, field) for field in ("task", "instruction", "operator")),
    *((ReviewItems, ITEM, field) for field in ("reason", "reviewer")),
    *((StartRequest, START, field) for field in ("world", "task", "instruction")),
    *((NewRecording, TAKE, field) for field in ("task", "instruction", "station", "operator")),
    (SubmittedMark, MARK, "comment"),
    (RunRequest, {"kind": "camera", "subject": "head"}, "board"),
    (Answer, {}, "text"),
    (Criterion, {"name": "touched", "points": 1}, "description"),
    *((kind, {}, "station") for kind in (AcquisitionSettings, DashboardSettings, UpSettings)),
]
OF_LINES = {"reason", "comment"}


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(("kind", "others", "field"), FIELDS)
def test_what_people_type_is_refused(kind, others, field, bad):
    with pytest.raises(ValidationError, match=rf"U\+{ord(bad[0]):04X}.* at position 3"):
        kind.model_validate(others | {field: f"abc{bad}def"})


@pytest.mark.parametrize(("kind", "others", "field"), FIELDS)
def test_only_notes_have_lines(kind, others, field):
    for text in ("two\nlines", "a\ttab"):
        if field in OF_LINES:
            assert getattr(kind.model_validate(others | {field: text}), field) == text
        else:
            with pytest.raises(ValidationError, match="one line"):
                kind.model_validate(others | {field: text})


@pytest.mark.parametrize("good", GOOD)
@pytest.mark.parametrize(("kind", "others", "field"), FIELDS)
def test_words_of_every_language_are_accepted(kind, others, field, good):
    assert getattr(kind.model_validate(others | {field: good}), field) == good


@pytest.mark.parametrize("kind", [FreeText, FreeLines])
def test_lone_surrogates_are_refused(kind):
    with pytest.raises(ValidationError):
        TypeAdapter(kind).validate_python("a\ud800")
    with pytest.raises(ValidationError):
        TypeAdapter(kind).validate_python(json.loads('"\\udfff"'))


@pytest.mark.parametrize(
    "more",
    [
        {"streams": [STREAM | {"unit": "m\x1b"}]},
        {"streams": [STREAM | {"frame": "world\u202e"}]},
        {"streams": [STREAM | {"device": "glove\nforged"}]},
        {"ledger": [{"stream": "head\x1b", "event": "lost", "count": 1}]},
        {"lineage": [{"kind": "recording", "id": "a\nb"}]},
        {"calibration": {"K_head\x9b": [[1.0]]}},
        {"quality": {"gap\u2028": 1.0}},
    ],
)
def test_texts_of_devices_and_files_in_an_upload_are_refused(more):
    with pytest.raises(ValidationError, match="changes how text is shown"):
        NewRecording.model_validate(TAKE | more)
    # As stored by earlier releases they can be read.
    RecordingAttributes.model_validate(TAKE | more)


def test_every_control_and_format_character_is_refused_or_known():
    """By the Unicode database; signs of writing that are seen, and both joiners, are left."""
    seen = "WITH|NUMBER SIGN|SANAH|FOOTNOTE|SAFHA|SAMVAT|AYAH|ABBREVIATION|POUND|PIASTRE|TAKHALLUS"
    for number in range(0x110000):
        character = chr(number)
        if unicodedata.category(character) not in {"Cc", "Cf", "Cs", "Zl", "Zp"}:
            continue
        if printable(character) == character:
            name = unicodedata.name(character)
            known = any(word in name for word in seen.split("|"))
            written = ("EGYPTIAN", "SHORTHAND", "MUSICAL", "KAITHI", "ARABIC", "SYRIAC")
            assert known or name.startswith(written) or character in "\u200c\u200d", name


def test_escapes_are_those_of_json():
    text = "a\x1b[2J\u202eb\nc\t\x9b\x7f\U000e0041é\u200c"
    assert printable(text) == r"a\u001b[2J\u202eb\nc\t\u009b\u007f" + r"\udb40\udc41é" + "\u200c"
    assert printable("a\nb\t\x1b", lines=True) == "a\nb\t\\u001b"


def test_a_result_on_standard_output_is_escaped_and_the_same(capsys):
    from pathlib import Path

    result = {"task": "a\u202eb\x7f\x9b\U000e0041é"}
    write_result(Path("-"), result)
    shown = capsys.readouterr().out
    assert shown.isascii() is False
    assert not set(shown) & set("\u202e\x7f\x9b\U000e0041")
    assert json.loads(shown) == result


@pytest.fixture
def old_store(tmp_path):
    """A store with a recording of an earlier release, whose texts nobody checked."""
    store = EpisodeStore(str(tmp_path))
    descriptor = StreamDescriptor.model_validate(STREAM)
    texts = {"task": "ta\x1b[2Jsk", "station": "de\u202esk\nforged line", "operator": "p\x9b1"}
    attributes = RecordingAttributes.model_validate(
        TAKE | texts | {"streams": (descriptor,), "started_at": datetime(2026, 1, 1, tzinfo=UTC)}
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        values = np.tile([0.0, 0, 0, 1, 0, 0, 0], (20, 1))
        writer.append("head", values=values, t_host_ns=np.arange(20) * 10_000_000)
    return store, str(tmp_path)


@pytest.mark.parametrize(
    "words", [["list"], ["show", "take-1"], ["verify"], ["list", "--json", "-"]]
)
def test_old_texts_are_escaped_where_a_store_is_printed(old_store, words, capsys):
    store, url = old_store
    assert store.recording("take-1").attributes.task == "ta\x1b[2Jsk"
    assert main(["store", *words, "--store", url]) == 0
    shown = "".join(capsys.readouterr())
    assert "take-1" in shown
    assert not set(shown) & set("\x1b\u202e\x9b")
    assert not any(line.startswith("forged line") for line in shown.splitlines())


async def test_old_texts_are_served_and_new_ones_refused(old_store):
    _, url = old_store
    app = create_app(EpisodeStoreSettings(store_url=url))
    transport = ASGITransport(app)
    async with AsyncClient(transport=transport, base_url="http://localhost") as client:
        listed = (await client.get("/v1/recordings")).json()["recordings"]
        assert listed[0]["task"] == "ta\x1b[2Jsk"
        for field in ("task", "station", "operator", "instruction"):
            body = TAKE | {"recording_id": "take-2", field: "a\x1bb"}
            refused = await client.post("/v1/recordings", json=body)
            assert refused.status_code == 422
            assert "U+001B" in refused.json()["detail"]


def test_a_file_of_tasks_with_such_texts_is_refused(tmp_path):
    path = tmp_path / "tasks.toml"
    path.write_text('[[tasks]]\nname = "a\\u001Bb"\ninstructions = ["stand it up"]\n')
    with pytest.raises(InvalidInputError, match=r"U\+001B"):
        load_tasks(path)


def test_a_refusal_of_a_command_is_escaped(capsys, monkeypatch):
    def refuse(_):
        raise InvalidInputError("a file says \x1b[2J\u202e")

    monkeypatch.setattr("services.cli.main.run_command", refuse)
    assert main(["store", "list"]) == 3
    shown = "".join(capsys.readouterr())
    assert "[2J" in shown
    assert not set(shown) & set("\x1b\u202e")


def test_the_console_log_is_escaped(capsys):
    configure_logging(service="probe", log_format="console", level="info")
    log = structlog.get_logger("probe")
    log.info("saved", path="/a\x1b[2J\nforged_line\u202e")
    try:
        check_line("bad \x1b[2J text" * 2)
    except ValueError as error:
        error.add_note("bad \x1b[2J note")
        log.exception("failed")
    shown = capsys.readouterr().err
    assert "forged_line" in shown
    assert not set(shown) & set("\x1b\u202e")
    assert not any(line.startswith("forged_line") for line in shown.splitlines())
    assert "Traceback" in shown
