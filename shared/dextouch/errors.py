"""Every error that DexTouch raises: one tree, one class for each decision that a caller can take.

```
DexTouchError
├── InvalidInputError          the caller sent something that does not fit: mend the input
│   ├── ShapeError             an array has the wrong shape or kind of number
│   ├── NonFiniteError         NaN or infinity where a finite number is needed
│   ├── DegenerateRotationError  six numbers that span no plane, or a matrix that is no rotation
│   ├── UnknownNameError       a name that is not among the valid ones (which are listed)
│   ├── ClockFitError          stamps from which no clock can be fitted
│   └── PacketError            bytes that are no packet of the announced kind
├── NotFoundError              the thing asked for does not exist
├── ConflictError              the thing exists in another state than the request assumes
│   └── EndedError             a rollout is over: start a new one or branch from its end
├── LimitExceededError         larger, longer or more than this installation allows
├── UnavailableError           a service, model or world that is not ready: try again later
├── DeviceError                a device is gone, silent or speaks another protocol
│   └── StaleDataError         the newest sample is older than the caller allows
├── StorageError               bytes on disk are damaged, foreign or cannot be written
│   ├── CorruptDataError       a checksum or structure does not hold
│   └── StorageFullError       no space left: free some
└── AccessDeniedError          no key, or a key without the needed scope
```
"""


class DexTouchError(Exception):
    """Root of all errors raised on purpose.

    The message says what, where, got, expected and what to do. `details` holds the same facts
    as data for machines (problem+json, logs).
    """

    def __init__(self, message: str, **details: object) -> None:
        super().__init__(message)
        self.message = message
        self.details = details


class InvalidInputError(DexTouchError):
    """The caller sent something that does not fit."""


class ShapeError(InvalidInputError):
    """An array has the wrong shape or kind of number."""


class NonFiniteError(InvalidInputError):
    """NaN or infinity where a finite number is needed."""


class DegenerateRotationError(InvalidInputError):
    """Numbers that describe no rotation."""


class UnknownNameError(InvalidInputError):
    """A name that is not among the valid ones."""

    def __init__(self, kind: str, name: str, valid: list[str]) -> None:
        listed = ", ".join(sorted(valid)) or "none"
        super().__init__(f"unknown {kind} {name!r}; valid: {listed}", got=name, valid=sorted(valid))


class ClockFitError(InvalidInputError):
    """Stamps from which no clock can be fitted."""


class PacketError(InvalidInputError):
    """Bytes that are no packet of the announced kind."""


class NotFoundError(DexTouchError):
    """The thing asked for does not exist."""


class ConflictError(DexTouchError):
    """The thing exists in another state than the request assumes."""


class EndedError(ConflictError):
    """A rollout is over: its world goes no further with it, for a `reason` it names."""

    def __init__(self, message: str, *, reason: str, **details: object) -> None:
        super().__init__(message, reason=reason, **details)

    @property
    def reason(self) -> str:
        """Why, in words."""
        return str(self.details.get("reason", self.message))


class LimitExceededError(DexTouchError):
    """Larger, longer or more than this installation allows."""


class UnavailableError(DexTouchError):
    """A service, model or world is not ready."""


class DeviceError(DexTouchError):
    """A device is gone, silent or speaks another protocol."""


class StaleDataError(DeviceError):
    """The newest sample is older than the caller allows."""


class StorageError(DexTouchError):
    """Bytes on disk are damaged, foreign or cannot be written."""


class CorruptDataError(StorageError):
    """A checksum or structure does not hold."""


class StorageFullError(StorageError):
    """No space left: free some."""


class AccessDeniedError(DexTouchError):
    """No key, or a key without the needed scope."""
