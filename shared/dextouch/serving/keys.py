"""API keys of a service: what each of them allows, and how requests are checked against them."""

import hashlib
import hmac
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

from pydantic import Field, SecretStr, field_validator

from dextouch.errors import AccessDeniedError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import KEY_NAME_PATTERN

MIN_LENGTH: Final = 16  # with which random hexadecimal keys reach MIN_BITS
# So many guesses take 35 years at a thousand a second. By this estimate 97 of 100 random keys of 16
# hexadecimal digits have as many, and all of 32 digits: the least of 20,000 had 75.
MIN_BITS: Final = 40
# Neighbours in these rows, in both directions, are orderly, as are those in the alphabet.
KEYBOARD_ROWS: Final = ("1234567890", "qwertyuiop", "asdfghjkl", "zxcvbnm")
# Keys that documentation of this or an earlier release showed.
PUBLISHED: Final = frozenset(
    {"16 characters or more", "the-key-of-the-store", "$(openssl rand -hex 32)"}
)
# Of a repetition; shorter ones also occur in random keys.
REPEATED: Final = 3
# A character is orderly if it follows the last one, or the last but one as in "a1b2c3d4".
LAGS: Final = (1, 2)
HOW_TO: Final = "make a key with: openssl rand -hex 32"


def check_strength(key: str) -> None:
    """Raise ValueError, which does not repeat the key, if a key is easy to guess."""
    if len(key) < MIN_LENGTH:
        raise ValueError(f"got {len(key)} characters, expected at least {MIN_LENGTH}; {HOW_TO}")
    if key.lower() in PUBLISHED:
        raise ValueError(f"got a key that is printed in the documentation; {HOW_TO}")
    if (bits := estimated_bits(key)) < MIN_BITS:
        raise ValueError(
            f"got a key that repeats itself or goes in order (about {bits:.0f} bits), expected at "
            f"least {MIN_BITS}; {HOW_TO}"
        )


def estimated_bits(key: str) -> float:
    """How many bits a key has at most: those of each character that does not follow from others.

    A character follows from others if it ends three characters that occur earlier, or goes on a
    series: steps of at most one in the alphabet, the digits or a row of the keyboard.
    """
    text = key.lower()
    num_free = sum(not _follows(text, index) for index in range(len(text)))
    return num_free * math.log2(max(1, len(set(text))))


def _follows(text: str, index: int) -> bool:
    last = text[max(0, index + 1 - REPEATED) : index + 1]
    if len(last) == REPEATED and last in text[:index]:
        return True
    # A single step could be chance.
    return any(
        index > lag and _is_step(text, index, lag) and _is_step(text, index - 1, lag)
        for lag in LAGS
    )


def _is_step(text: str, index: int, lag: int) -> bool:
    before, after = text[index - lag], text[index]
    is_near = abs(ord(after) - ord(before)) <= 1
    return is_near or any(before + after in row or after + before in row for row in KEYBOARD_ROWS)


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
        return AccessDeniedError(
            "unknown key: expected one of this service's api_keys, or of an enrolled station",
            reason="unknown_key",
        )
    return AccessDeniedError(
        "no key: expected the header 'Authorization: Bearer KEY'", reason="missing_key"
    )


class AccessControl:
    """The keys of one service; without keys (loopback only, see settings) access is open."""

    def __init__(self, api_keys: Sequence[ApiKey]) -> None:
        self._enrolled: tuple[tuple[bytes, Grant], ...] = ()
        self.set_keys(api_keys)

    def set_keys(self, api_keys: Sequence[ApiKey]) -> None:
        """Accept these keys in place of those of the settings."""
        self._keys = tuple((secret_digest(key.key.get_secret_value()), key) for key in api_keys)

    @property
    def has_keys(self) -> bool:
        """Whether the service requires a key."""
        return bool(self._keys)

    @property
    def key_names(self) -> frozenset[str]:
        """Names of the keys of the settings."""
        return frozenset(key.name for _, key in self._keys)

    @property
    def names(self) -> frozenset[str]:
        """Names of all keys."""
        return self.key_names | {grant.name for _, grant in self._enrolled}

    def set_enrolled(self, enrolled: Sequence[tuple[bytes, Grant]]) -> None:
        """Accept these keys, given as digests, beside those of the settings, and no earlier ones.

        A service without keys of its settings stays open.
        """
        self._enrolled = tuple(enrolled)

    def find(self, authorization: str | None) -> Grant | None:
        """What the key in the header allows, if it is a valid one."""
        return self.of_digest(secret_digest(presented_key(authorization) or ""))

    def of_digest(self, presented: bytes) -> Grant | None:
        """What the key with this `secret_digest` allows, if it is a valid one."""
        # Every key is compared, to avoid a timing side channel.
        known = (*self._keys, *self._enrolled)
        matches = [grant for digest, grant in known if hmac.compare_digest(digest, presented)]
        return matches[0] if matches else None

    def granted(self, authorization: str | None, scope: str) -> Grant:
        """What a key allows; raises AccessDeniedError without it or the scope (see `reason`)."""
        if not self._keys:
            return _open_grant(scope)
        grant = self.find(authorization)
        if grant is None:
            raise no_key(authorization)
        grant.require(scope)
        return grant

    def check(self, authorization: str | None, scope: str) -> str:
        """Check a key and its scope as `granted`, and return the key's name."""
        return self.granted(authorization, scope).name


@lru_cache(maxsize=64)
def _open_grant(scope: str) -> Grant:
    return Grant(name="loopback", scopes=(scope,))


def secret_digest(text: str) -> bytes:
    """By which keys and tokens are compared and kept."""
    # JSON can hold halves of UTF-16 pairs, which are no valid key.
    return hashlib.sha256(text.encode(errors="surrogatepass")).digest()


def presented_key(authorization: str | None) -> str | None:
    """The key in the header, valid or not; None without one."""
    kind, _, token = (authorization or "").partition(" ")
    # Api-Key is what clients of openpi send.
    return token.strip() or None if kind.lower() in {"bearer", "api-key"} else None
