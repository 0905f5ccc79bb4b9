"""Problems of pydantic as one line: what a validator of ours says stands there as it said it."""

import pytest
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from dextouch.schemas import first_problems


class Rate(BaseModel):
    rate_hz: float

    @model_validator(mode="after")
    def _whole(self):
        if self.rate_hz % 1:
            raise ValueError(f"got {self.rate_hz} Hz, expected a whole number")
        return self


@pytest.mark.parametrize(
    ("rate_hz", "line"),
    [
        (0.5, "fields: got 0.5 Hz, expected a whole number"),
        ("x", "rate_hz: Input should be a valid number, unable to parse string as a number"),
    ],
)
def test_one_line_without_noise(rate_hz, line):
    with pytest.raises(ValidationError) as caught:
        Rate(rate_hz=rate_hz)
    assert first_problems(caught.value) == line


class Nothing(BaseModel):
    model_config = ConfigDict(extra="forbid")


@pytest.mark.parametrize(
    ("num_mistakes", "line"),
    [
        (1000, "; ".join(f"{n}: Extra inputs are not permitted" for n in range(5))),
        (1001, "got 1001 mistakes, which are too many to name"),
    ],
)
def test_very_many_mistakes_are_counted(num_mistakes, line):
    with pytest.raises(ValidationError) as caught:
        Nothing.model_validate({str(n): 0 for n in range(num_mistakes)})
    assert first_problems(caught.value) == line
