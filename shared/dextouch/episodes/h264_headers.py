"""Headers of H.264 access units (ITU-T H.264, 7.3), to find out where an access unit is missing.

A decoder fills the place of a lost reference picture with another picture, without an error.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from dextouch.errors import CorruptDataError

START_CODE = b"\x00\x00\x01"
SLICE, IDR_SLICE, SEQUENCE_PARAMETERS, PICTURE_PARAMETERS = 1, 5, 7, 8
# Profiles whose parameter sets begin with the chroma format (7.3.2.1.1).
_CHROMA_PROFILES = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}
# More than enough for the fields of a slice header up to its frame number.
_HEADER_BYTES = 32


@dataclass(frozen=True)
class _SequenceParameters:
    """How slices of a sequence number their pictures."""

    number_bits: int
    has_colour_planes: bool
    may_skip_numbers: bool


class _Bits:
    """Reader of the bits of a NAL unit, without its first byte."""

    def __init__(self, nal: bytes) -> None:
        # Bytes that keep the content from looking like a start code (7.4.1.1).
        payload = nal[1:].replace(b"\x00\x00\x03", b"\x00\x00")
        self._value, self._left = int.from_bytes(payload, "big"), 8 * len(payload)

    def read(self, count: int) -> int:
        """The next bits, as an unsigned number."""
        self._left -= count
        if self._left < 0:
            raise CorruptDataError("H.264: a header is cut off")
        return (self._value >> self._left) & ((1 << count) - 1)

    def unsigned(self) -> int:
        """The next Exp-Golomb code (9.1)."""
        zeros = 0
        while not self.read(1):
            zeros += 1
        return (1 << zeros) - 1 + self.read(zeros)

    def skip_codes(self, count: int) -> None:
        """Skip Exp-Golomb codes, signed or unsigned."""
        for _ in range(count):
            self.unsigned()

    def skip_scaling_list(self, size: int) -> None:
        """Skip a scaling list (7.3.2.1.1.1)."""
        last = following = 8
        for _ in range(size):
            if following:
                code = self.unsigned()
                delta = (code + 1) // 2 if code % 2 else -(code // 2)
                following = (last + delta) % 256
            last = following or last


def nal_units(access_unit: bytes) -> Iterator[bytes]:
    """The NAL units of an access unit (Annex B), without start codes."""
    start = access_unit.find(START_CODE)
    while 0 <= start < len(access_unit) - 3:
        stop = access_unit.find(START_CODE, start + 3)
        yield access_unit[start + 3 : stop if stop >= 0 else len(access_unit)]
        start = stop


def first_gap(access_units: Sequence[bytes]) -> int | None:
    """Index of the first access unit of a group before which a reference picture is missing.

    None where there is none, or where the encoder may skip numbers. A picture is numbered one
    higher than the last reference picture before it (7.4.3, frame_num), and an IDR picture 0.

    Raises:
        CorruptDataError: a header that cannot be read, or no slice; `place` in its details is the
            index of the access unit.
    """
    parameters = _parameters(access_units[0])
    if parameters.may_skip_numbers:
        return None
    last_reference = 0
    for index, access_unit in enumerate(access_units):
        try:
            nal = _first_slice(access_unit)
            number = _frame_number(nal, parameters)
        except CorruptDataError as error:
            raise CorruptDataError(error.message, place=index) from error
        expected = (last_reference + 1) % (1 << parameters.number_bits) if index else 0
        if number != expected:
            return index
        if nal[0] & 0x60:
            last_reference = number
    return None


def _first_slice(access_unit: bytes) -> bytes:
    for nal in nal_units(access_unit):
        if nal[0] & 0x1F in {SLICE, IDR_SLICE}:
            return nal[:_HEADER_BYTES]
    raise CorruptDataError("H.264: an access unit has no slice of a picture")


def _frame_number(nal: bytes, parameters: _SequenceParameters) -> int:
    bits = _Bits(nal)
    bits.skip_codes(3)  # first_mb_in_slice, slice_type, pic_parameter_set_id
    if parameters.has_colour_planes:
        bits.read(2)
    return bits.read(parameters.number_bits)


def _parameters(access_unit: bytes) -> _SequenceParameters:
    found = (nal for nal in nal_units(access_unit) if nal[0] & 0x1F == SEQUENCE_PARAMETERS)
    nal = next(found, None)
    if nal is None:
        raise CorruptDataError("H.264: first image of a group has no parameter sets")
    bits = _Bits(nal)
    profile = bits.read(24) >> 16
    bits.skip_codes(1)  # seq_parameter_set_id
    has_colour_planes = profile in _CHROMA_PROFILES and _skip_chroma(bits)
    number_bits = bits.unsigned() + 4
    order = bits.unsigned()  # pic_order_cnt_type
    if order == 0:
        bits.skip_codes(1)
    elif order == 1:
        bits.read(1)
        bits.skip_codes(2)
        bits.skip_codes(bits.unsigned())
    bits.skip_codes(1)  # max_num_ref_frames
    return _SequenceParameters(number_bits, has_colour_planes, bool(bits.read(1)))


def _skip_chroma(bits: _Bits) -> bool:
    """Skip chroma format, bit depths and scaling lists; whether colour planes are separate."""
    chroma = bits.unsigned()
    has_colour_planes = chroma == 3 and bool(bits.read(1))
    bits.skip_codes(2)
    bits.read(1)
    if bits.read(1):
        for number in range(12 if chroma == 3 else 8):
            if bits.read(1):
                bits.skip_scaling_list(16 if number < 6 else 64)
    return has_colour_planes
