"""Types of fields that several schemas share."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

ID_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,127}$"
StoreId = Annotated[str, Field(pattern=ID_PATTERN)]
# Of a W3C trace (docs/operations.md#traces).
TraceId = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
Domain = Literal["human", "robot"]
Origin = Literal["recorded", "twin", "imagined"]
# Source of a stream's time stamps: the device's stamps, its sequence numbers, counting of samples,
# or plain arrival times.
ClockMethod = Literal["device", "sequence", "counting", "arrival"]
# Reasons to doubt the times of a stream: its clock is far off its nominal rate, even the promptest
# samples arrive more than a sample period later than fitted, or a stop of the clock cannot be
# distinguished from an increase of the path delay.
ClockWarning = Literal["skew", "residual", "stop"]
# Validation of lists in uploads stops at the first mistake: to collect 500,000 takes seconds.
Matrix = Annotated[
    tuple[Annotated[tuple[FiniteFloat, ...], Field(fail_fast=True)], ...], Field(fail_fast=True)
]
NonNegativeFinite = Annotated[FiniteFloat, Field(ge=0)]
# Centre x y z and half sizes x y z of a bounding box.
Box = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
