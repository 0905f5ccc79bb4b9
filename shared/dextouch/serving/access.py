"""Access control by bearer keys and scopes, compared in constant time."""

import hashlib
import hmac
from collections.abc import Sequence

from fastapi import Request

from dextouch.errors import AccessDeniedError
from dextouch.serving.settings import ApiKey


def not_signed_in() -> AccessDeniedError:
    """Error for a browser without a session."""
    return AccessDeniedError("not signed in: open / and sign in", reason="missing_key")


class AccessControl:
    """The keys of one service; without keys (loopback only, see settings) access is open."""

    def __init__(self, api_keys: Sequence[ApiKey]) -> None:
        self._keys = [(_digest(key.key.get_secret_value()), key) for key in api_keys]

    @property
    def has_keys(self) -> bool:
        """Whether the service requires a key."""
        return bool(self._keys)

    def knows(self, authorization: str | None) -> bool:
        """Whether the header contains a valid key."""
        return self._find(authorization) is not None

    def identify(self, authorization: str | None) -> ApiKey:
        """The key in the header.

        Raises:
            AccessDeniedError: no key, or an unknown one (see `reason`).
        """
        if _token(authorization) is None:
            raise AccessDeniedError(
                "no key: expected the header 'Authorization: Bearer KEY'", reason="missing_key"
            )
        key = self._find(authorization)
        if key is None:
            raise AccessDeniedError("unknown key", reason="unknown_key")
        return key

    def check(self, authorization: str | None, scope: str) -> str:
        """Check a key and its scope, and return the key's name.

        Raises:
            AccessDeniedError: no key, an unknown one (see `reason`), or one without the scope.
        """
        if not self._keys:
            return "loopback"
        key = self.identify(authorization)
        if scope not in key.scopes:
            raise AccessDeniedError(
                f"key {key.name!r} lacks the scope {scope!r}; it has: {', '.join(key.scopes)}",
                reason="missing_scope",
                scope=scope,
            )
        return key.name

    def _find(self, authorization: str | None) -> ApiKey | None:
        token = _token(authorization)
        if token is None:
            return None
        presented = _digest(token)
        # Every key is compared, to avoid a timing side channel.
        matches = [key for digest, key in self._keys if hmac.compare_digest(digest, presented)]
        return matches[0] if matches else None


class RequireScope:
    """Route dependency that requires a scope: `dependencies=[Depends(RequireScope("rollout"))]`."""

    def __init__(self, scope: str) -> None:
        self.scope = scope

    async def __call__(self, request: Request) -> str:
        """The name of the caller's key; raises AccessDeniedError."""
        access: AccessControl = request.app.state.access
        return access.check(request.headers.get("authorization"), self.scope)


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()


def _token(authorization: str | None) -> str | None:
    kind, _, token = (authorization or "").partition(" ")
    return token.strip() or None if kind.lower() == "bearer" else None
