"""Image codecs of the store: JPEG, and H.264 in closed groups of pictures through PyAV.

A `jpeg` group is one image, an `h264` one a closed group of pictures. One access unit is one image;
without B-frames their order is that of the input, so image k of a group needs exactly its first
k + 1 access units. No other module of the store uses PyAV.

A decoder fills in what is missing of a damaged image, and the place of a lost reference picture;
such an image is refused here, and so are the images of its group that depend on it. The headers of
access units (ITU-T H.264, 7.3) say where one is missing.
"""

import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from dextouch.episodes.format import GOP_IMAGES, GROUP_IMAGES, ImageCodec
from dextouch.errors import CorruptDataError, InvalidInputError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.images import check_jpeg, decode_jpeg

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

# Averaging chroma over 2×2 pixels is as fast as nearest-neighbour and gains 0.25 dB.
# SWS_AREA | SWS_FULL_CHR_H_INP of libswscale: with full chroma input it stays in its vectorized
# path, which takes little more than half the time at the same PSNR.
_TO_YUV = 0x20 | 0x4000
_TO_RGB = "BICUBIC"


@cache
def _one_thread() -> dict[str, Any]:
    """Arguments by which PyAV converts images in this thread: from 17 on it starts others."""
    import av

    return {"threads": 1} if int(av.__version__.partition(".")[0]) >= 17 else {}


class VideoSettings(FrozenModel):
    """H.264 encoder settings; a lower `crf` gives better quality and larger files."""

    crf: int = Field(default=25, ge=1, le=51)
    preset: str = Field(default="ultrafast", pattern="^[a-z]+$")


@dataclass(frozen=True)
class ImageForm:
    """Requested form of decoded images: `half_size` in both axes, `gray` with one channel."""

    half_size: bool = False
    gray: bool = False

    def shape(self, stored: tuple[int, ...]) -> tuple[int, int, int]:
        """Output height, width and channels for a stored shape [h, w, 3]."""
        divisor = 2 if self.half_size else 1
        return stored[0] // divisor, stored[1] // divisor, 1 if self.gray else 3


FULL_FORM = ImageForm()


def is_keyframe(access_unit: bytes) -> bool:
    """Whether an H.264 access unit (Annex B) is an IDR picture preceded by its parameter sets."""
    return bool(parameter_sets(access_unit))


def parameter_sets(access_unit: bytes) -> bytes:
    """The sequence and picture parameter sets before an IDR picture; empty if there are none."""
    kinds: set[int] = set()
    found = b""
    for nal in nal_units(access_unit):
        kind = nal[0] & 0x1F
        if kind in {IDR_SLICE, SLICE}:
            whole = kinds == {SEQUENCE_PARAMETERS, PICTURE_PARAMETERS} and kind == IDR_SLICE
            return found if whole else b""
        if kind in {SEQUENCE_PARAMETERS, PICTURE_PARAMETERS}:
            kinds.add(kind)
            found += START_CODE + nal
    return b""


def check_video_size(height: int, width: int) -> None:
    """Raise InvalidInputError for sides that 4:2:0 H.264 cannot encode: odd or empty ones."""
    if height % 2 or width % 2 or not height or not width:
        raise InvalidInputError(
            f"H.264: got images of {height} x {width} pixels, expected even numbers; "
            "use the unit 'jpeg' for this camera"
        )


class GopEncoder:
    """Persistent encoder of one camera with images of even sides, in groups of pictures.

    `rate_hz` is nominal, for players of the stream; the store takes only its own `group_images`.

    Raises:
        InvalidInputError: an invalid size or invalid settings.
    """

    def __init__(
        self,
        height: int,
        width: int,
        *,
        rate_hz: float,
        settings: VideoSettings,
        group_images: int = GOP_IMAGES,
    ) -> None:
        import av
        from av.video.reformatter import VideoReformatter

        check_video_size(height, width)
        self._shape, self._index = (height, width, 3), 0
        self._context: Any = av.CodecContext.create("libx264", "w")
        self._context.width, self._context.height = width, height
        self._context.pix_fmt = "yuv420p"
        rate = Fraction(rate_hz).limit_denominator(1001)
        self._context.framerate, self._context.time_base = rate, 1 / rate
        self._context.gop_size = group_images
        x264 = (
            f"keyint={group_images}:min-keyint={group_images}:scenecut=0:open-gop=0:bframes=0"
            # Half-pixel motion: a seventh fewer bytes for a tenth more time, and faster decoding.
            ":threads=1:sliced-threads=0:subme=1"
        )
        self._context.options = {
            "crf": str(settings.crf),
            "preset": settings.preset,
            "tune": "zerolatency",
            "x264-params": x264,
        }
        try:
            self._context.open()
        except av.FFmpegError as error:
            raise InvalidInputError(f"H.264 encoder: {settings} refused ({error})") from error
        self._reformatter = VideoReformatter()
        self.description = f"libx264 {settings.preset} crf {settings.crf} gop {group_images}"

    def encode(self, image: np.ndarray) -> bytes:
        """Encode the next image, uint8 [h, w, 3] RGB, to an access unit."""
        import av

        if image.shape != self._shape or image.dtype != np.uint8:
            raise InvalidInputError(
                f"H.264: got {image.dtype} {image.shape}, expected uint8 {self._shape}"
            )
        rgb = av.VideoFrame.from_numpy_buffer(np.ascontiguousarray(image), format="rgb24")
        frame = self._reformatter.reformat(
            rgb, format="yuv420p", interpolation=_TO_YUV, **_one_thread()
        )
        frame.pts = self._index
        packets = self._context.encode(frame)
        if len(packets) != 1:
            raise StorageError(
                f"H.264: image {self._index} gave {len(packets)} access units, expected 1; "
                "this build of libx264 delays its output"
            )
        self._index += 1
        return bytes(packets[0])


class GopDecoder:
    """Decoder of groups of pictures of one image size."""

    def __init__(self, height: int, width: int) -> None:
        from av.video.reformatter import VideoReformatter

        self._shape = (height, width)
        self._context: Any = None
        self._parameters = b""
        self._reformatter = VideoReformatter()

    def decode(
        self, access_units: list[bytes], wanted: list[int], form: ImageForm, out: np.ndarray
    ) -> None:
        """Decode images of a group into `out`, uint8 [n, *form.shape]; raises as `frames`.

        `access_units` go up to the last requested image, `wanted` are n ascending indices.
        """
        rows = {place: row for row, place in enumerate(wanted)}
        for place, frame in enumerate(self.frames(access_units)):
            if place in rows:
                self._write(frame, form, out[rows[place]])

    def frames(self, access_units: Sequence[bytes]) -> Iterator["VideoFrame"]:
        """Decode a group, or its first images, one by one; ends with an error at damage.

        Raises:
            CorruptDataError: an image is damaged or missing, or has another size; `place` in its
                details is the first image that cannot be trusted.
        """
        import av

        gap = first_gap(access_units)
        self._begin(parameter_sets(access_units[0]))
        place, late = 0, None
        try:
            for sent, access_unit in enumerate((*access_units, None)):
                packet = None if access_unit is None else av.Packet(access_unit)
                if packet is None and place == len(access_units):
                    break
                for frame in self._context.decode(packet):
                    self._check(frame, place, gap)
                    yield frame
                    place += 1
                if late is None and place <= sent:
                    late = sent
        except (av.FFmpegError, ValueError) as error:
            raise CorruptDataError(
                f"H.264: image {place} of a group cannot be decoded ({error})", place=place
            ) from error
        if place != len(access_units):
            # From the first access unit on that gave no image in time, numbers may be wrong.
            raise CorruptDataError(
                f"H.264: got {place} images from {len(access_units)} access units", place=late or 0
            )

    def _check(self, frame: "VideoFrame", place: int, gap: int | None) -> None:
        if gap is not None and place >= gap:
            raise CorruptDataError(
                f"H.264: the picture before image {place} of a group is missing", place=place
            )
        if frame.is_corrupt:
            raise CorruptDataError(
                f"H.264: image {place} of a group is damaged, and the decoder filled in what is "
                "missing",
                place=place,
            )
        if (frame.height, frame.width) != self._shape:
            raise CorruptDataError(
                f"H.264: got an image of {frame.height} x {frame.width} pixels, "
                f"expected {self._shape[0]} x {self._shape[1]}",
                place=place,
            )

    def _begin(self, parameters: bytes) -> None:
        """Reset the decoder, so that the next group is independent of earlier ones."""
        import av

        if not parameters:
            raise CorruptDataError("H.264: first image of a group has no parameter sets")
        if parameters == self._parameters:
            self._context.flush_buffers()
            return
        # A decoder that refuses parameter sets continues with the previous ones.
        self._context = av.CodecContext.create("h264", "r")
        self._context.thread_count = 1
        # The bound keeps a forged header from allocating gigabytes.
        pixels = (self._shape[0] + 16) * (self._shape[1] + 16)
        self._context.options = {
            "flags": "+low_delay",
            "max_pixels": str(pixels),
            # Bits that are left over after the last macroblock are damage, too. With "explode",
            # an invalid message beside an intact picture would count as well.
            "err_detect": "aggressive",
        }
        self._parameters = parameters

    def _write(self, frame: "VideoFrame", form: ImageForm, out: np.ndarray) -> None:
        height, width, channels = out.shape
        converted = self._reformatter.reformat(
            frame,
            width=width,
            height=height,
            format="gray" if form.gray else "rgb24",
            # Area scaling averages each 2×2 pixels, as the other codecs do.
            interpolation="AREA" if form.half_size else _TO_RGB,
            **_one_thread(),
        )
        plane = converted.planes[0]
        rows = np.frombuffer(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)
        out[...] = rows[:height, : width * channels].reshape(out.shape)


_DECODERS = threading.local()
_MAX_DECODERS = 4


def decoder_of_this_thread(height: int, width: int) -> GopDecoder:
    """Thread-local decoder, since creating one takes longer than decoding an image."""
    known: dict[tuple[int, int], GopDecoder] = _DECODERS.__dict__.setdefault("by_size", {})
    if (height, width) not in known:
        while len(known) >= _MAX_DECODERS:
            known.pop(next(iter(known)))
        known[height, width] = GopDecoder(height, width)
    return known[height, width]


def check_group(
    access_units: Sequence[bytes], size_px: tuple[int, int]
) -> list[UInt8[np.ndarray, "h w 1"]]:
    """Decode a group of pictures, or its first images, to their luma; raises as `frames`."""
    height, width = size_px
    planes = (f.planes[0] for f in decoder_of_this_thread(height, width).frames(access_units))
    return [
        np.frombuffer(memoryview(p), np.uint8).reshape(-1, p.line_size)[:height, :width, None]
        for p in planes
    ]


def pack_group(codec: ImageCodec, images: Sequence[bytes]) -> bytes:
    """Bytes of a group in hashes, and in storage chunks of v2.

    Of `jpeg` the image; of `h264` u32 number of images, u32 length of each, the images; little
    endian.
    """
    if codec == "jpeg":
        return images[0]
    return struct.pack(f"<{1 + len(images)}I", len(images), *map(len, images)) + b"".join(images)


def unpack_group(codec: ImageCodec, payload: bytes, what: str) -> list[bytes]:
    """Inverse of `pack_group`; raises CorruptDataError, `what` names the storage chunk in it."""
    if codec == "jpeg":
        return [payload]
    count, most = int.from_bytes(payload[:4], "little"), GROUP_IMAGES[codec]
    if not 1 <= count <= most or len(payload) < 4 * (1 + count):
        raise CorruptDataError(f"{what}: got {count} images, expected 1 … {most}")
    lengths = struct.unpack_from(f"<{count}I", payload, 4)
    bounds = list(accumulate(lengths, initial=4 * (1 + count)))
    if bounds[-1] != len(payload):
        raise CorruptDataError(f"{what}: images end at byte {bounds[-1]} of {len(payload)}")
    return [payload[start:stop] for start, stop in pairwise(bounds)]


@dataclass(frozen=True)
class ImageGroups:
    """Decoder for the groups of one stream of encoded images.

    `shape` is [h, w, 3] of an image, `what` the array's name in errors.
    """

    codec: ImageCodec
    shape: tuple[int, ...]
    what: str

    @property
    def size(self) -> int:
        """Images of a group; the last one may have fewer."""
        return GROUP_IMAGES[self.codec]

    def decode(
        self, images: list[bytes], number: int, places: list[int], form: ImageForm, out: np.ndarray
    ) -> None:
        """Decode images of group `number` into `out`.

        `images` are those of the group up to the last requested one, `places` the ascending indices
        of the requested ones in the group, `out` is uint8 [len(places), *form.shape(shape)]. Raises
        CorruptDataError for invalid image data.
        """
        with self._located(number):
            if self.codec == "jpeg":
                self._decode_jpeg(images[0], form, out[0])
            else:
                decoder_of_this_thread(*self.shape[:2]).decode(images, places, form, out)

    def check(self, images: list[bytes], number: int) -> None:
        """Decode group `number` by the rule of `decode`, and discard the images.

        Raises CorruptDataError for an image that cannot be decoded; `place` in the details is the
        first such image of the group.
        """
        with self._located(number):
            if self.codec == "jpeg":
                check_jpeg(images[0], (self.shape[0], self.shape[1]))
            else:
                check_group(images, (self.shape[0], self.shape[1]))

    @contextmanager
    def _located(self, number: int) -> Iterator[None]:
        """Name the damaged image by its index in the stream."""
        try:
            yield
        except CorruptDataError as error:
            place = int(str(error.details.get("place", 0)))
            raise CorruptDataError(
                f"{self.what}: image {number * self.size + place}: "
                f"{error.message}; readers by time leave out such images, and "
                "`dextouch store repair` writes the item without them",
                place=place,
                image=number * self.size + place,
            ) from error

    def _decode_jpeg(self, data: bytes, form: ImageForm, out: np.ndarray) -> None:
        # At half size libjpeg skips half of the DCT coefficients, which is faster than averaging.
        half = {"min_height": out.shape[0], "min_width": out.shape[1], "min_factor": 2}
        reduced = half if form.half_size else {}
        image = decode_jpeg(data, size_px=self.shape[:2], gray=form.gray, **reduced)
        # A half of an odd size is rounded up there and down here.
        out[...] = image[: out.shape[0], : out.shape[1]]


def transform_pixels(images: np.ndarray, form: ImageForm) -> np.ndarray:
    """Plain uint8 images [n, h, w, 3] in another form.

    Half size is the mean of 2×2 pixels, gray the luma of ITU-R BT.601.
    """
    if form.gray:
        weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
        images = np.rint(images @ weights)[..., None].astype(np.uint8)
    if form.half_size:
        n, height, width, channels = images.shape
        even = images[:, : height // 2 * 2, : width // 2 * 2]
        blocks = even.reshape(n, height // 2, 2, width // 2, 2, channels)
        images = np.rint(blocks.mean(axis=(2, 4), dtype=np.float32)).astype(np.uint8)
    return images


START_CODE = b"\x00\x00\x01"
SLICE, IDR_SLICE, SEQUENCE_PARAMETERS, PICTURE_PARAMETERS = 1, 5, 7, 8
# Profiles whose parameter sets begin with the chroma format (7.3.2.1.1).
_CHROMA_PROFILES = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}
# Times from one image to the next after which one is missing, where only they tell.
MOST_STEPS = 2.5
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
    Raises CorruptDataError without a readable header or a slice; `place` in its details is the
    index.
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


class FrameNumbers:
    """The numbers of a video's pictures, access unit by access unit (see `first_gap`)."""

    def __init__(self) -> None:
        self._parameters: _SequenceParameters | None = None
        self._last_reference = 0
        self._is_whole = True

    def is_whole(self, access_unit: bytes, num_steps: float) -> bool:
        """Whether no reference picture is missing since the last IDR picture.

        `num_steps` is the time since the access unit before, in those from one image to the next:
        numbers repeat, and some encoders skip them. Raises CorruptDataError without a readable
        header; what follows is not whole then.
        """
        was_whole, self._is_whole = self._is_whole, False
        if any(nal[0] & 0x1F == SEQUENCE_PARAMETERS for nal in nal_units(access_unit)):
            self._parameters = _parameters(access_unit)
        nal = _first_slice(access_unit)
        is_first, parameters = nal[0] & 0x1F == IDR_SLICE, self._parameters
        if parameters is None:
            self._is_whole = was_whole
            return was_whole
        number, size = _frame_number(nal, parameters), 1 << parameters.number_bits
        follows = parameters.may_skip_numbers or number == (self._last_reference + 1) % size
        most = MOST_STEPS if parameters.may_skip_numbers else max(MOST_STEPS, size / 2)
        if nal[0] & 0x60:
            self._last_reference = number
        self._is_whole = is_first or (was_whole and follows and num_steps < most)
        return self._is_whole

    def lose(self) -> None:
        """Say that a picture could not be decoded."""
        self._is_whole = False


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
