"""Hand files that are hostile or damaged by chance: an error of ours or a sound hand, always."""

import os
import re

import numpy as np
import pytest

from dextouch.errors import (
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    UnknownNameError,
)
from dextouch.hands.hand_files import load_hand, models
from tests.unit.hands.hand_texts import FINGER_MAPPING as FINGER
from tests.unit.hands.hand_texts import FINGER_MJCF as MJCF
from tests.unit.hands.hand_texts import documented_mappings, four_finger_urdf, write_hand

URDF, MAPPING = four_finger_urdf(), documented_mappings()[1]


def refused(tmp_path, model, mapping, message, error=InvalidInputError):
    with pytest.raises(error, match=message):
        load_hand(*write_hand(tmp_path, model, mapping))


ENTITIES = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
OUTSIDE = '<!DOCTYPE r SYSTEM "file:///etc/passwd">'


@pytest.mark.parametrize("doctype", [ENTITIES, OUTSIDE, "<!DOCTYPE r>"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_document_types_are_refused(doctype, encoding, tmp_path):
    hostile = f"{doctype}{MJCF}".encode(encoding)
    refused(tmp_path, hostile, FINGER, "line 1: got a document type")


@pytest.mark.parametrize(
    ("model", "error", "message"),
    [
        (b"", InvalidInputError, "invalid XML"),
        (b"\x00\xff\xfe", InvalidInputError, "invalid XML"),
        (
            b'<?xml version="1.0" encoding="klingon"?><robot/>',
            InvalidInputError,
            "unknown enc|invalid",
        ),
        (b'<?xml version="1.0" encoding="utf-7"?><robot/>', InvalidInputError, "unknown text enc"),
        (b"<html/>", InvalidInputError, "expected <robot> .URDF. or <mujoco>"),
        (b"<robot/>", UnknownNameError, "valid: none"),
        (b"<mujoco/>", UnknownNameError, "valid: world"),
        (b"<robot>" + b" " * 2**23 + b"</robot>", LimitExceededError, "more than 8388608 bytes"),
        (b"<a>" * 101 + b"</a>" * 101, LimitExceededError, "100 nested"),
        (b"<a>" * 2**21, LimitExceededError, "100 nested"),
        (b"<r>" + b"<a/>" * 500 + b"</r>", LimitExceededError, "100 nested or 500 XML elements"),
    ],
)
def test_files_that_are_no_model_are_refused(model, error, message, tmp_path, monkeypatch):
    monkeypatch.setattr(models, "MAX_ELEMENTS", 500)
    refused(tmp_path, model, FINGER, message, error)


@pytest.mark.parametrize(
    ("mapping", "error", "message"),
    [
        (b"\xff\xfe", InvalidInputError, "invalid UTF-8"),
        (b"a = " + b"[" * 60_000, InvalidInputError, "invalid TOML"),
        (b"#" * (2**16 + 1), LimitExceededError, "more than 65536 bytes"),
        (b"a = 1\na = 2", InvalidInputError, "invalid TOML"),
    ],
)
def test_files_that_are_no_mapping_are_refused(mapping, error, message, tmp_path):
    refused(tmp_path, MJCF, mapping, message, error)


def test_paths_that_are_no_files_are_refused(tmp_path):
    model, mapping = write_hand(tmp_path, MJCF, FINGER)
    with pytest.raises(NotFoundError, match="no such file"):
        load_hand(tmp_path / "none.urdf", mapping)
    with pytest.raises(InvalidInputError, match="expected a regular file"):
        load_hand(model, tmp_path)
    with pytest.raises(InvalidInputError, match="expected a regular file"):
        load_hand(os.devnull, mapping)
    with pytest.raises(StorageError, match="cannot be read"):
        load_hand(tmp_path / ("x" * 300), mapping)


@pytest.mark.parametrize(("model", "mapping"), [(URDF, MAPPING), (MJCF, FINGER)])
def test_truncated_models_are_refused(model, mapping, tmp_path):
    # The last cut that still misses the end of the outermost element.
    for cut in [*range(0, len(model.rstrip()), 97), len(model.rstrip()) - 1]:
        refused(tmp_path, model[:cut], mapping, "invalid XML")


WORDS = ["nan", "-1e300", "0 0", "world", "fixed", "joint_3", "", "]", '"', "<", "palm", "1e-320"]


def mutated(text, rng):
    """A word exchanged for another one, a nasty one or a number, or a span cut out."""
    words = list(re.finditer(r"[\w.+-]+", text))
    word = words[rng.integers(len(words))]
    choice = rng.integers(4)
    if choice == 0:
        end = min(len(text), word.end() + int(rng.integers(60)))
        return text[: word.start()] + text[end:]
    if choice == 1:
        new = words[rng.integers(len(words))].group()
    elif choice == 2:
        new = WORDS[rng.integers(len(WORDS))]
    else:
        new = repr(float(rng.normal(0, 10.0 ** rng.integers(-4, 4))))
    return text[: word.start()] + new + text[word.end() :]


@pytest.mark.long
@pytest.mark.parametrize(("model", "mapping"), [(URDF, MAPPING), (MJCF, FINGER)])
@pytest.mark.parametrize("which", ["model", "mapping"])
def test_mutated_files_give_a_sound_hand_or_an_error_of_ours(model, mapping, which, tmp_path):
    rng = np.random.default_rng(5)
    num_loaded, refusals = 0, set()
    for _ in range(100):
        texts = {"model": model, "mapping": mapping}
        for _ in range(rng.integers(1, 4)):
            texts[which] = mutated(texts[which], rng)
        try:
            hand = load_hand(*write_hand(tmp_path, texts["model"], texts["mapping"]))
        except DexTouchError as error:
            refusals.add(str(error))
            continue
        num_loaded += 1
        middle = 0.5 * (hand.lower_rad + hand.upper_rad)
        assert np.isfinite(hand.chain_points_m(np.stack([hand.lower_rad, middle]))).all()
        assert (hand.lower_rad < hand.upper_rad).all()
    # Else the mutations were so coarse that little behind the parsers was reached. (Hardly a word
    # of a mapping can change without harm; many numbers of a model can.)
    assert which == "mapping" or num_loaded > 0
    assert len(refusals) > 20
    assert max(map(len, refusals)) < 2000
