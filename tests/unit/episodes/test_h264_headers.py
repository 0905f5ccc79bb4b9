"""Numbers of H.264 pictures, of encoders whose headers differ, against what was taken out."""

from fractions import Fraction

import av
import numpy as np
import pytest

from dextouch.episodes import first_gap, is_keyframe
from dextouch.errors import CorruptDataError
from tests.unit.bridges.lerobot_episodes import SIZE_PX, pictures


def levels(count):
    """Different weights, so that none is left to the decoder."""
    return ",".join(str(16 + 3 * index % 32) for index in range(count))


# Parameter sets of many profiles: with scaling lists, other chroma, slices, wrapping numbers.
ENCODERS = {
    "baseline": ("baseline", "yuv420p", ""),
    "high": ("high", "yuv420p", "cabac=1:8x8dct=1"),
    "scaling lists": ("high", "yuv420p", "cqm=jvt"),
    "other scaling lists": ("high", "yuv420p", f"8x8dct=1:cqm4={levels(16)}:cqm8={levels(64)}"),
    "10 bits": ("high10", "yuv420p10le", ""),
    "4:4:4": ("high444", "yuv444p", "cqm=jvt"),
    "slices": ("main", "yuv420p", "slices=4"),
    "references": ("high", "yuv420p", "ref=4:weightp=2"),
    "order 2": ("baseline", "yuv420p", "bframes=0:ref=1"),
}


def encode(name, count):
    """Access units of one group, without B-frames."""
    profile, pixels, more = ENCODERS[name]
    context = av.CodecContext.create("libx264", "w")
    context.height, context.width, context.pix_fmt = *SIZE_PX, pixels
    context.framerate, context.time_base = Fraction(30), Fraction(1, 30)
    params = f"keyint=1000:min-keyint=1000:scenecut=0:bframes=0:{more}".rstrip(":")
    context.options = {"profile": profile, "tune": "zerolatency", "x264-params": params}
    units = []
    for index, image in enumerate(pictures(count)):
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
        frame.pts = index
        units += [bytes(packet) for packet in context.encode(frame)]
    assert len(units) == count
    return units


@pytest.mark.parametrize("name", ENCODERS)
def test_a_missing_picture_is_found_where_it_was(name):
    units = encode(name, 40)
    assert is_keyframe(units[0])
    assert first_gap(units) is None
    assert first_gap(units[:1]) is None
    for lost in (1, 2, 7, 15, 16, 17, 33, 38):
        assert first_gap(units[:lost] + units[lost + 1 :]) == lost
    assert first_gap([*units[:5], units[4], *units[5:]]) == 5


def test_pictures_that_nothing_refers_to_do_not_count():
    """Their number is that of the next reference picture (7.4.3), so that they may be dropped."""
    units = encode("baseline", 6)
    # nal_ref_idc 0 of the slice of unit 3; what follows it then has the same number again.
    start = units[3].rfind(b"\x00\x00\x01") + 3
    unreferenced = units[3][:start] + bytes([units[3][start] & 0x1F]) + units[3][start + 1 :]
    assert first_gap([*units[:3], unreferenced, units[3], *units[4:]]) is None
    assert first_gap([*units[:3], unreferenced, *units[4:]]) == 4


def test_headers_that_are_cut_are_refused_with_their_place():
    units = encode("high", 4)
    with pytest.raises(CorruptDataError) as caught:
        first_gap([*units[:2], b"\x00\x00\x01\x41", units[3]])
    assert caught.value.details["place"] == 2
    with pytest.raises(CorruptDataError, match="no parameter sets"):
        first_gap(units[1:])
    noise = np.random.default_rng(0)
    for _ in range(200):
        # Never another error than ours.
        body = b"\x00\x00\x01\x67" + noise.integers(0, 256, 12, dtype=np.uint8).tobytes()
        try:
            first_gap([body + units[0]])
        except CorruptDataError:
            continue
