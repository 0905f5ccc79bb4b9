"""Exceptions of DexTouch: one tree, one class for each decision that a caller can take."""


class DexTouchError(Exception):
    """Base class of all errors that DexTouch raises deliberately.

    The message says what, where, got, expected and what to do. `details` holds the same facts
    as data for machines (problem+json, logs).
    """

    def __init__(self, message: str, **details: object) -> None:
        super().__init__(message)
        self.message = message
        self.details = details

    def __reduce__(self) -> tuple[object, ...]:
        # Subclasses have other arguments than those of the built-in class, which pickle would use.
        return _restored, (type(self), self.args), self.__dict__


def _restored(kind: type[DexTouchError], arguments: tuple[object, ...]) -> DexTouchError:
    return kind.__new__(kind, *arguments)


class InvalidInputError(DexTouchError):
    """Input from the caller is invalid: correct it and retry."""


class ShapeError(InvalidInputError):
    """An array has the wrong shape or kind of number."""


class NonFiniteError(InvalidInputError):
    """NaN or infinity where a finite number is needed."""


class DegenerateRotationError(InvalidInputError):
    """Numbers that describe no rotation."""


class UnknownNameError(InvalidInputError):
    """A name that is not among the valid ones, which are listed."""

    def __init__(self, kind: str, name: str, valid: list[str]) -> None:
        listed = ", ".join(sorted(valid)) or "none"
        super().__init__(f"unknown {kind} {name!r}; valid: {listed}", got=name, valid=sorted(valid))


class ClockFitError(InvalidInputError):
    """Stamps to which no clock can be fitted."""


class PacketError(InvalidInputError):
    """Bytes that are not a valid packet of their kind."""


class NotFoundError(DexTouchError):
    """The requested item does not exist."""


class ConflictError(DexTouchError):
    """The item is in another state than the request assumes."""


class EndedError(ConflictError):
    """A rollout is over for this `reason`: start a new one or branch from its end."""

    def __init__(self, message: str, *, reason: str, **details: object) -> None:
        super().__init__(message, reason=reason, **details)

    @property
    def reason(self) -> str:
        """Why the rollout ended."""
        return str(self.details.get("reason", self.message))


class LimitExceededError(DexTouchError):
    """Larger, longer or more than this installation allows."""


class UnavailableError(DexTouchError):
    """A service, model or world is not ready: try again later."""


class DeviceError(DexTouchError):
    """A device is disconnected, silent or speaks another protocol."""


class StaleDataError(DeviceError):
    """The newest sample is older than the caller allows."""


class StorageError(DexTouchError):
    """Bytes on disk are damaged, foreign or cannot be written."""


class CorruptDataError(StorageError):
    """A checksum mismatch or an invalid structure."""


class StorageFullError(StorageError):
    """No space left on the device: free some."""


class AccessDeniedError(DexTouchError):
    """No key, or a key without the needed scope."""
