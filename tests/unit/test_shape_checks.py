"""Checks of annotations under tests: what they refuse, in the packages and in small functions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest
from jaxtyping import Float64, TypeCheckError

from dextouch.clients import PolicyStart
from dextouch.geometry import pinhole_matrix
from dextouch.hands.actions import AnchorPoses
from tests.shape_checks import CHECKED_CALLS, begin_test, decorated

if TYPE_CHECKING:
    from services.twin.stage import Stage


def test_the_packages_are_checked():
    anchor = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
    assert PolicyStart("reach", "", 0, anchor, np.eye(3)).seed == 0
    for wrong in (np.eye(4), np.eye(3, dtype=np.float32)):
        with pytest.raises(TypeCheckError):
            PolicyStart("reach", "", 0, anchor, wrong)
    with pytest.raises(TypeCheckError):
        pinhole_matrix(width_px=8.5, height_px=8, fovy_rad=1.0)


@decorated
def product(
    left: Float64[np.ndarray, "rows inner"], right: Float64[np.ndarray, "inner columns"]
) -> Float64[np.ndarray, "rows columns"]:
    """Wrong where the left one has a single row."""
    return left @ right if len(left) > 1 else np.zeros((2, right.shape[1]))


def test_an_axis_has_one_length_in_a_call_and_another_in_the_next():
    assert product(np.ones((2, 3)), np.ones((3, 4))).shape == (2, 4)
    assert product(np.ones((5, 6)), np.ones((6, 7))).shape == (5, 7)
    with pytest.raises(TypeCheckError):
        product(np.ones((2, 3)), np.ones((4, 3)))
    with pytest.raises(TypeCheckError):
        product(np.ones((1, 3)), np.ones((3, 4)))
    assert product(np.ones((2, 3)), np.ones((3, 4))).shape == (2, 4)


def test_calls_within_calls_have_axes_of_their_own():
    @decorated
    def outer(rows: Float64[np.ndarray, " rows"]) -> Float64[np.ndarray, " rows"]:
        product(np.ones((len(rows) + 1, 2)), np.ones((2, 2)))
        return rows

    assert len(outer(np.zeros(4))) == 4


def test_plain_annotations_are_checked_too():
    @decorated
    def words(count: int) -> "str":
        return "word" if count else 7

    assert words(1) == "word"
    with pytest.raises(TypeCheckError):
        words("1")
    with pytest.raises(TypeCheckError):
        words(0)


def test_fields_of_a_dataclass_are_checked():
    @decorated
    @dataclass(frozen=True)
    class Pair:
        left: Float64[np.ndarray, " count"]
        right: Float64[np.ndarray, " count"]

    @decorated
    @dataclass(frozen=True)
    class Named(Pair):
        name: "str"

    assert Named(np.zeros(2), np.zeros(2), "a").name == "a"
    with pytest.raises(TypeCheckError):
        Pair(np.zeros(2), np.zeros(3))
    with pytest.raises(TypeCheckError):
        Named(np.zeros(2), np.zeros(3), "a")
    with pytest.raises(TypeCheckError):
        Named(np.zeros(2), np.zeros(2), 7)


def test_methods_properties_and_generators():
    class Box:
        @property
        @decorated
        def size(self) -> int:
            return "large"

        @classmethod
        @decorated
        def of(cls, size: int) -> "Box":
            return cls()

        @decorated
        def sizes(self, count: int) -> Iterator[int]:
            yield from range(count)

    assert list(Box().sizes(3)) == [0, 1, 2]
    with pytest.raises(TypeCheckError):
        Box().sizes("3")
    with pytest.raises(TypeCheckError):
        _ = Box().size
    with pytest.raises(TypeCheckError):
        Box.of("3")


def test_names_that_only_type_checkers_know_are_not_checked():
    @decorated
    def played(stage: "Stage", seed: int) -> int:
        return seed

    assert played(None, 3) == 3
    with pytest.raises(TypeCheckError):
        played(None, "3")


def test_the_first_calls_of_each_test_are_checked():
    @decorated
    def half(count: int) -> int:
        return count // 2

    for _ in range(CHECKED_CALLS):
        with pytest.raises(TypeCheckError):
            half(3.0)
    assert half(3.0) == 1.0
    begin_test()
    with pytest.raises(TypeCheckError):
        half(3.0)
