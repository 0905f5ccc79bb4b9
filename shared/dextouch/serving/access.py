"""A bearer key to the scopes it has, or a refusal; compared in constant time."""

import hashlib
import hmac
from collections.abc import Sequence

from fastapi import Request

from dextouch.errors import AccessDeniedError
from dextouch.serving.settings import ApiKey


class AccessControl:
    """The keys of one service; without keys (loopback only, see settings) everyone may."""

    def __init__(self, api_keys: Sequence[ApiKey]) -> None:
        self._keys = [(_digest(key.key.get_secret_value()), key) for key in api_keys]

    def check(self, authorization: str | None, scope: str) -> str:
        """The name of the key that may.

        Raises:
            AccessDeniedError: no key, an unknown one (`reason` tells which), or one without
                the scope.
        """
        if not self._keys:
            return "loopback"
        kind, _, token = (authorization or "").partition(" ")
        if kind.lower() != "bearer" or not token:
            raise AccessDeniedError(
                "no key: expected the header 'Authorization: Bearer KEY'", reason="missing_key"
            )
        presented = _digest(token.strip())
        # Every key is compared, so that the time tells nothing about which one was near.
        matches = [key for digest, key in self._keys if hmac.compare_digest(digest, presented)]
        if not matches:
            raise AccessDeniedError("unknown key", reason="unknown_key")
        if scope not in matches[0].scopes:
            raise AccessDeniedError(
                f"key {matches[0].name!r} lacks the scope {scope!r}; it has: "
                f"{', '.join(matches[0].scopes)}",
                reason="missing_scope",
                scope=scope,
            )
        return matches[0].name


class RequireScope:
    """A route dependency: `dependencies=[Depends(RequireScope("rollout"))]`."""

    def __init__(self, scope: str) -> None:
        self.scope = scope

    async def __call__(self, request: Request) -> str:
        """The name of the caller's key; raises AccessDeniedError."""
        access: AccessControl = request.app.state.access
        return access.check(request.headers.get("authorization"), self.scope)


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()
