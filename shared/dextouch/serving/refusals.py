"""Refused callers: wrong keys are slowed down, and every refusal leaves a line in the log.

Both are limited by the address of the caller and over all addresses, in bounded memory.
"""

import ipaddress
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import structlog
from starlette.requests import HTTPConnection
from starlette.types import Scope

from dextouch.errors import AccessDeniedError
from dextouch.serving.keys import AccessControl, presented_key
from dextouch.serving.logs import MASK

logger = structlog.get_logger(__name__)

PERIOD_S: Final = 60.0  # limits are of a minute
# A person who mistypes a key stays below.
MAX_PER_ADDRESS: Final = 10
# All addresses together: many more stations and people than have a wrong key at the same time.
MAX_OVERALL: Final = 100
# Lines of the log a minute about one kind of refusal of an address. Of all kinds these are fewer
# than MAX_OVERALL, at which a day of refusals takes some 40 MB.
MAX_LINES: Final = 5
# Some 100 bytes each; of more, those that were silent for the longest time are forgotten.
MAX_ADDRESSES: Final = 4096
# A provider gives a customer at least this much of IPv6, so that one caller has all of it.
IPV6_PREFIX: Final = 64
MAX_SHOWN_PATH: Final = 200
REQUEST: Final = "request_refused"
# Reason of a refusal because of earlier wrong keys.
TOO_MANY: Final = "too_many_wrong_keys"
# Statuses of callers that are refused, rather than of requests that fail.
REFUSED: Final = frozenset({401, 403, 408, 413, 415, 421, 429, 431})


class RateLimit:
    """Token buckets by address, and one over all addresses; thread-safe.

    A bucket begins with a minute's events, and refills evenly. Events beyond the limit take
    nothing, so that a single address cannot use up the share of all others.
    """

    def __init__(
        self,
        per_address: int = MAX_PER_ADDRESS,
        overall: int = MAX_OVERALL,
        *,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._per_address, self._overall, self._clock_s = per_address, overall, clock_s
        self._lock = threading.Lock()
        # By address: what was left, and when that was. The one over all has no address.
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._of_all = (float(overall), clock_s())

    def wait_s(self, address: str, kind: str = "") -> float:
        """Count an event; the time until the next one is within the limits, 0 if this one is.

        Events of different kinds have buckets of their own.
        """
        name = f"{_owner(address)} {kind}"
        with self._lock:
            now_s = self._clock_s()
            before = self._buckets.get(name, (float(self._per_address), now_s))
            own, own_wait_s = _refilled(before, self._per_address, now_s)
            overall, wait_s = _refilled(self._of_all, self._overall, now_s)
            taken = 0.0 if own_wait_s or wait_s else 1.0
            self._of_all = overall - taken, now_s
            self._buckets[name] = own - taken, now_s
            self._buckets.move_to_end(name)
            if len(self._buckets) > MAX_ADDRESSES:
                self._buckets.popitem(last=False)
        return max(own_wait_s, wait_s)


def _refilled(bucket: tuple[float, float], size: int, now_s: float) -> tuple[float, float]:
    left = min(float(size), bucket[0] + (now_s - bucket[1]) * size / PERIOD_S)
    return left, 0.0 if left >= 1 else (1 - left) * PERIOD_S / size


def _owner(address: str) -> str:
    """The caller behind an address; of IPv6 the network that belongs to a single one."""
    with suppress(ValueError):
        ip = ipaddress.ip_address(address)
        if isinstance(ip, ipaddress.IPv6Address):
            mapped = ip.ipv4_mapped
            return str(mapped or ipaddress.ip_network((int(ip), IPV6_PREFIX), strict=False))
        return str(ip)
    # As a proxy may name a caller.
    return address[:64]


def caller_of(scope: Scope) -> str:
    """Address of the caller of a request or WebSocket, as a trusted proxy names it."""
    address: str = (scope.get("client") or ("unknown",))[0]
    return address[:64]


class WrongKeys:
    """Slows down callers who guess keys or tokens; call it only for those that are not valid.

    So a valid key is accepted from every address, whatever else is sent from there.
    """

    def __init__(self) -> None:
        self._limit = RateLimit()

    def count(self, connection: HTTPConnection, *, what: str = "key") -> None:
        """Count a wrong key; raises AccessDeniedError for too many of this address, or in all."""
        caller = caller_of(connection.scope)
        if wait_s := self._limit.wait_s(caller):
            raise AccessDeniedError(
                f"unknown {what}, one of too many: expected at most {MAX_PER_ADDRESS} a minute "
                f"from an address (this is {caller}) and {MAX_OVERALL} from all together; check "
                f"the {what}, a valid one is accepted at once",
                reason=TOO_MANY,
                retry_after_s=int(wait_s) + 1,
            )


class RefusalLog:
    """One line for each refusal, of which a flood leaves only some, with the number of the others.

    `access` knows the names of keys.
    """

    def __init__(self, access: AccessControl | None = None, limit: RateLimit | None = None) -> None:
        self._access = access
        self._limit = RateLimit(MAX_LINES) if limit is None else limit
        self._num_not_logged = 0

    def note(self, connection: HTTPConnection, status: int, reason: str) -> None:
        """Log a refused request or WebSocket: its method, path, address and the name of its key.

        `reason` is a word, or a sentence without anything secret.
        """
        scope, path = connection.scope, connection.scope["path"]
        is_request = scope["type"] == "http"
        authorization = connection.headers.get("authorization")
        grant = None if self._access is None else self._access.find(authorization)
        if key := presented_key(authorization):
            # A client may send its key in the wrong place as well.
            path = path.replace(key, MASK)
        self.note_caller(
            caller_of(scope),
            status,
            reason,
            event=REQUEST if is_request else "websocket_refused",
            method=scope["method"] if is_request else None,
            path=path[:MAX_SHOWN_PATH],
            key=None if grant is None else grant.name,
        )

    def note_caller(
        self, caller: str, status: int, reason: str, *, event: str = REQUEST, **more: str | None
    ) -> None:
        """Log a refusal of which there may be no request."""
        if self._limit.wait_s(caller, f"{event} {status}"):
            self._num_not_logged += 1
            return
        given: dict[str, object] = {name: one for name, one in more.items() if one is not None}
        if self._num_not_logged:
            given["num_not_logged"], self._num_not_logged = self._num_not_logged, 0
        logger.warning(event, client=caller, status=status, reason=reason, **given)
