"""The function that simulates a kind of device, imported when a mock station wants it."""

from collections.abc import Callable
from importlib.metadata import EntryPoint

from dextouch.errors import InvalidInputError
from services.acquisition.devices.registry import (
    ENTRY_POINT_GROUP,
    IMPORT_FAILURES,
    device_kind,
    kind_names,
)
from services.acquisition.mocks.pair import MockPair
from services.acquisition.mocks.place import MockPlace


def mock_of(name: str) -> Callable[[MockPlace], MockPair]:
    """What makes a simulated device of the kind of this name.

    Raises:
        UnknownNameError: no package brings the kind.
        InvalidInputError: the kind has no mock, or it cannot be imported.
    """
    kind = device_kind(name)
    if kind.mock is None:
        raise InvalidInputError(
            f"kind of device {name!r}: got no mock, expected one to simulate it; choose another "
            f"kind for the mock station ({', '.join(kind_names())}) or write its mock"
        )
    point = EntryPoint(name=name, value=kind.mock, group=ENTRY_POINT_GROUP)
    try:
        make = point.load()
    except IMPORT_FAILURES as error:
        raise InvalidInputError(
            f"mock of kind {name!r} ({kind.mock}): got {type(error).__name__}: {error}, expected "
            "a function 'module:function' of a MockPlace; fix the package that provides the kind"
        ) from error

    def checked(place: MockPlace) -> MockPair:
        pair: object = make(place)
        if not isinstance(pair, MockPair):
            raise InvalidInputError(
                f"mock of kind {name!r} ({kind.mock}): gave {type(pair).__name__}, expected a "
                "services.acquisition.mocks.MockPair; fix the package that provides the kind"
            )
        return pair

    return checked
