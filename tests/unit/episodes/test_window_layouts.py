"""Windows of gloves of other layouts as messages."""

import numpy as np
import pytest

from dextouch.episodes import Window, decode_window, encode_window
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses
from dextouch.streams import pack, unpack
from dextouch.tactile import DEXTOUCH_V1
from tests.unit.other_gloves import largest_layout


def encoded(layout):
    window = Window(
        images={},
        image_dt_ns={},
        tactile_kpa=np.ones((3, 2, layout.num_taxels), np.float32),
        tactile_valid=np.ones((3, 2), np.bool_),
        actions=np.zeros((3, 67)),
        action_kind="measured",
        instruction="press",
        t_ref_ns=np.arange(3),
        anchor=AnchorPoses(np.eye(4), np.eye(4), np.eye(4)),
        K_head=None,
        actions_measured=np.ones((3, 67), np.bool_),
        taxels_measured=np.ones((2, layout.num_taxels), np.bool_),
        tactile_layout=layout,
    )
    return encode_window(window)


def test_a_window_holds_the_largest_layout():
    layout = largest_layout()
    again = decode_window(encoded(layout), max_bytes=1 << 20)
    assert again.tactile_layout.model_dump() == layout.model_dump()
    assert again.tactile_kpa.shape == (3, 2, 4096)


def test_a_window_of_our_glove_names_no_layout():
    fields, _ = unpack(encoded(DEXTOUCH_V1), max_bytes=1 << 20)
    assert set(fields) == {"action_kind", "instruction"}


@pytest.mark.parametrize("text", ["{}", "{", " " * (2**16 + 1), {"name": "small"}, 5])
def test_what_is_no_layout_is_refused(text):
    fields, arrays = unpack(encoded(DEXTOUCH_V1), max_bytes=1 << 20)
    with pytest.raises(InvalidInputError, match="window: 'tactile_layout' is"):
        decode_window(pack({**fields, "tactile_layout": text}, arrays), max_bytes=1 << 20)
