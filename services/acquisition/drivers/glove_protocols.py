"""The name of a public glove protocol comes in; its decoder goes out."""

from typing import Literal

from dextouch.errors import InvalidInputError
from dextouch.tactile.layout import Side
from services.acquisition.drivers.glove_justfloat import JustFloatGloveDecoder
from services.acquisition.drivers.glove_wuji import WujiGloveDecoder

VendorProtocol = Literal["wuji", "justfloat"]


def vendor_glove_decoder(
    protocol: VendorProtocol,
    side: Side,
    *,
    num_values: int | None = None,
    full_scale: float | None = None,
    rate_hz: float | None = None,
) -> WujiGloveDecoder | JustFloatGloveDecoder:
    """A decoder of the family.

    Args:
        protocol: the family.
        side: which hand's glove it must be.
        num_values: float32s of a packet; of `justfloat` alone, as are the rest.
        full_scale: the largest reading.
        rate_hz: nominal rate.

    Raises:
        InvalidInputError: `justfloat` without its three numbers.
    """
    if protocol == "wuji":
        return WujiGloveDecoder(side)
    if num_values is None or full_scale is None or rate_hz is None:
        raise InvalidInputError(
            f"glove {side}: got num_values={num_values}, full_scale={full_scale}, "
            f"rate_hz={rate_hz}, expected all three for protocol 'justfloat'"
        )
    return JustFloatGloveDecoder(
        side, num_values=num_values, full_scale=full_scale, rate_hz=rate_hz
    )
