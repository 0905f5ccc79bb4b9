"""API keys of a service: what each of them allows, and how requests are checked against them."""

import hashlib
import hmac
from collections.abc import Sequence

from pydantic import Field, SecretStr, field_validator

from dextouch.errors import AccessDeniedError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import KEY_NAME_PATTERN
from dextouch.serving.key_strength import check_strength


class Grant(FrozenModel):
    """What a key allows; `name` appears in logs.

    A key with a `station` uploads recordings of this station only.
    """

    name: str = Field(pattern=KEY_NAME_PATTERN)
    scopes: tuple[str, ...] = Field(min_length=1)
    station: str | None = Field(default=None, min_length=1, max_length=128)

    def require(self, scope: str) -> None:
        """Raise AccessDeniedError if the key lacks a scope."""
        if scope not in self.scopes:
            raise AccessDeniedError(
                f"key {self.name!r} lacks the scope {scope!r}; it has: {', '.join(self.scopes)}",
                reason="missing_scope",
                scope=scope,
            )


class ApiKey(Grant):
    """A key of the settings; weak ones are refused."""

    key: SecretStr

    @field_validator("key")
    @classmethod
    def _is_strong(cls, key: SecretStr) -> SecretStr:
        check_strength(key.get_secret_value())
        return key


def not_signed_in() -> AccessDeniedError:
    """Error for a browser without a session."""
    return AccessDeniedError("not signed in: open / and sign in", reason="missing_key")


def no_key(authorization: str | None) -> AccessDeniedError:
    """Error for a request with an unknown key, or with none."""
    if presented_key(authorization) is not None:
        return AccessDeniedError("unknown key", reason="unknown_key")
    return AccessDeniedError(
        "no key: expected the header 'Authorization: Bearer KEY'", reason="missing_key"
    )


class AccessControl:
    """The keys of one service; without keys (loopback only, see settings) access is open."""

    def __init__(self, api_keys: Sequence[ApiKey]) -> None:
        self._keys = tuple((secret_digest(key.key.get_secret_value()), key) for key in api_keys)
        self._enrolled: tuple[tuple[bytes, Grant], ...] = ()

    @property
    def has_keys(self) -> bool:
        """Whether the service requires a key."""
        return bool(self._keys)

    @property
    def names(self) -> frozenset[str]:
        """Names of all keys."""
        return frozenset(grant.name for _, grant in (*self._keys, *self._enrolled))

    def set_enrolled(self, enrolled: Sequence[tuple[bytes, Grant]]) -> None:
        """Accept these keys, given as digests, beside those of the settings, and no earlier ones.

        A service without keys of its settings stays open.
        """
        self._enrolled = tuple(enrolled)

    def find(self, authorization: str | None) -> Grant | None:
        """What the key in the header allows, if it is a valid one."""
        presented = secret_digest(presented_key(authorization) or "")
        # Every key is compared, to avoid a timing side channel.
        known = (*self._keys, *self._enrolled)
        matches = [grant for digest, grant in known if hmac.compare_digest(digest, presented)]
        return matches[0] if matches else None

    def granted(self, authorization: str | None, scope: str) -> Grant:
        """Check a key and its scope, and return what the key allows.

        Raises:
            AccessDeniedError: no key, an unknown one (see `reason`), or one without the scope.
        """
        if not self._keys:
            return Grant(name="loopback", scopes=(scope,))
        grant = self.find(authorization)
        if grant is None:
            raise no_key(authorization)
        grant.require(scope)
        return grant

    def check(self, authorization: str | None, scope: str) -> str:
        """Check a key and its scope as `granted`, and return the key's name."""
        return self.granted(authorization, scope).name


def secret_digest(text: str) -> bytes:
    """By which keys and tokens are compared and kept."""
    return hashlib.sha256(text.encode()).digest()


def presented_key(authorization: str | None) -> str | None:
    """The key in the header, valid or not; None without one."""
    kind, _, token = (authorization or "").partition(" ")
    # Api-Key is what clients of openpi send.
    return token.strip() or None if kind.lower() in {"bearer", "api-key"} else None
