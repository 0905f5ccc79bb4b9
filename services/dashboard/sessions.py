"""Browser sessions, opened with a key."""

import secrets
import time
from collections.abc import Callable

from starlette.requests import HTTPConnection

from dextouch.serving import AccessControl, not_signed_in

COOKIE = "dextouch_session"
SCOPE = "operate"
MAX_SESSIONS = 1000


class Sessions:
    """Access of browsers: open on loopback without keys, otherwise by signing in."""

    def __init__(
        self,
        access: AccessControl,
        *,
        needs_key: bool,
        lifetime_s: float,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.needs_key = needs_key
        self.lifetime_s = lifetime_s
        self._access = access
        self._clock_s = clock_s
        self._ends_s: dict[str, float] = {}

    def sign_in(self, key: str) -> str:
        """Open a session with a key of scope `operate` and return its token.

        Raises:
            AccessDeniedError: an unknown key or one without the scope.
        """
        self._access.check(f"Bearer {key}", SCOPE)
        now_s = self._clock_s()
        self._ends_s = {token: end for token, end in self._ends_s.items() if end > now_s}
        while len(self._ends_s) >= MAX_SESSIONS:
            self._ends_s.pop(next(iter(self._ends_s)))
        token = secrets.token_urlsafe(32)
        self._ends_s[token] = now_s + self.lifetime_s
        return token

    def sign_out(self, connection: HTTPConnection) -> None:
        """End the session of this browser and invalidate its cookie."""
        self._ends_s.pop(connection.cookies.get(COOKIE, ""), None)

    def allows(self, connection: HTTPConnection) -> bool:
        """Whether a request or WebSocket belongs to an open session."""
        if not self.needs_key:
            return True
        return self._ends_s.get(connection.cookies.get(COOKIE, ""), 0.0) > self._clock_s()

    def guard(self, connection: HTTPConnection) -> None:
        """Refuse browsers that are not signed in."""
        if not self.allows(connection):
            raise not_signed_in()
