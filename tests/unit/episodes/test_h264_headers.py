"""Numbers of H.264 pictures, of encoders whose headers differ, against what was taken out."""

from fractions import Fraction

import av
import numpy as np
import pytest

from dextouch.episodes import first_gap, is_keyframe
from dextouch.errors import CorruptDataError
from tests.unit.bridges.lerobot_episodes import SIZE_PX, pictures

# Parameter sets of many profiles, with other chroma, several slices and numbers that wrap.
ENCODERS = {
    "baseline": ("baseline", "yuv420p", ""),
    "high": ("high", "yuv420p", "cabac=1:8x8dct=1"),
    "scaling lists": ("high", "yuv420p", "cqm=jvt"),
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


@pytest.mark.long
@pytest.mark.parametrize("name", ENCODERS)
def test_a_missing_picture_is_found_where_it_was(name):
    units = encode(name, 40)
    assert is_keyframe(units[0])
    assert first_gap(units) is None
    assert first_gap(units[:1]) is None
    for lost in (1, 2, 7, 15, 16, 17, 33, 38):
        assert first_gap(units[:lost] + units[lost + 1 :]) == lost
    assert first_gap([*units[:5], units[4], *units[5:]]) == 5


def ue(value):
    """Exp-Golomb code of an unsigned number (9.1)."""
    bits = f"{value + 1:b}"
    return "0" * (len(bits) - 1) + bits


def se(value):
    """Of a signed one (9.1.1)."""
    return ue(2 * value - 1 if value > 0 else -2 * value)


def nal(header, bits):
    """A NAL unit behind its start code, with its trailing bits and emulation prevention."""
    bits += "1"
    bits += "0" * (-len(bits) % 8)
    data = bytearray()
    for byte in (int(bits[i : i + 8], 2) for i in range(0, len(bits), 8)):
        if data[-2:] == b"\0\0" and byte <= 3:
            data.append(3)
        data.append(byte)
    return b"\0\0\1" + bytes([header]) + bytes(data)


def parameters(*, number_bits=4, lists=(), order=0, may_skip=0):
    """A sequence parameter set of the profile High (7.3.2.1.1); `lists` by number."""
    bits = "01100100" + "00000000" + "00011110" + ue(0)  # profile, constraints, level, id
    bits += ue(1) + ue(0) + ue(0) + "0" + "1"  # 4:2:0, 8 bits, 8 bits, lists follow
    bits += "".join("1" + lists[k] if k in lists else "0" for k in range(8))
    bits += ue(number_bits - 4) + ue(order)
    bits += {0: ue(2), 1: "0" + se(-3) + se(2) + ue(2) + se(1) + se(-1), 2: ""}[order]
    bits += ue(1) + str(may_skip) + ue(3) + ue(2) + "1" + "1" + "0" + "0"
    return nal(0x67, bits)


def slices(number_bits, numbers):
    """Units of one slice each (7.3.3): its first macroblock, type, parameter set, number."""
    return [
        nal(0x65 if index == 0 else 0x41, ue(0) + ue(7) + ue(0) + f"{number:0{number_bits}b}")
        for index, number in enumerate(numbers)
    ]


# A weight of 12, which is 8 + 4, then 0, which ends the list (7.3.2.1.1.1).
ENDED_LIST = se(4) + se(-12)
SCALING_LISTS = {
    "none": {},
    "small": {1: "".join(map(se, [1, -1] * 8))},
    "large": {6: "".join(map(se, [1, -1] * 32)), 7: ENDED_LIST},
    "default": {0: se(-8), 6: se(-8)},
}


@pytest.mark.parametrize("lists", SCALING_LISTS)
@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("number_bits", [4, 9])
def test_parameter_sets_written_by_hand(lists, order, number_bits):
    about = parameters(number_bits=number_bits, lists=SCALING_LISTS[lists], order=order)
    units = slices(number_bits, [number % (1 << number_bits) for number in range(20)])
    units[0] = about + units[0]
    assert first_gap(units) is None
    assert first_gap(units[:7] + units[8:]) == 7


def test_an_encoder_that_may_skip_numbers_is_not_judged():
    first, *rest = slices(4, [0, 1, 4, 5])
    assert first_gap([parameters(may_skip=1) + first, *rest]) is None
    assert first_gap([parameters() + first, *rest]) == 2


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
