"""Keys and passwords of this process, hidden from logs and refusals wherever they would appear.

No message is meant to contain one. This is for those that a client sends in the wrong place, such
as the path of a URL, and for texts of libraries.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from urllib.parse import quote, urlsplit

from pydantic import BaseModel, SecretStr

MASK = "***"
# Shorter ones would be found in ordinary words.
MIN_LENGTH = 8
# Tokens and keys that the store issues, of which it keeps hashes alone: 32 bytes in URL-safe base64
# (`secrets.token_urlsafe`), unlike names of this length by a digit and letters of both cases.
ISSUED_KEY = re.compile(
    r"(?<![\w-])(?=[\w-]*\d)(?=[\w-]*[A-Z])(?=[\w-]*[a-z])[\w-]{43}(?![\w-])", re.ASCII
)
_secrets: dict[str, None] = {}


def hide_secrets(settings: BaseModel) -> None:
    """Hide the secrets of these settings from now on: every SecretStr, and passwords in URLs."""
    found = {secret for secret in _secrets_in(settings) if len(secret) >= MIN_LENGTH}
    # As they are written in URLs and in JSON.
    found |= {quote(secret, safe="") for secret in found}
    found |= {json.dumps(secret)[1:-1] for secret in found} | _secrets.keys()
    # The longest first, for secrets that contain others.
    ordered = sorted(found, key=len, reverse=True)
    _secrets.clear()
    _secrets.update(dict.fromkeys(ordered))


def masked(text: str) -> str:
    """The text without the secrets of this process, and without what looks like an issued key."""
    for secret in tuple(_secrets):
        if secret in text:
            text = text.replace(secret, MASK)
    return ISSUED_KEY.sub(MASK, text)


def _secrets_in(value: object) -> Iterator[str]:
    if isinstance(value, SecretStr):
        yield value.get_secret_value()
    elif isinstance(value, str):
        if "://" in value and "@" in value:
            yield urlsplit(value).password or ""
    elif isinstance(value, BaseModel):
        yield from _secrets_in([getattr(value, name) for name in type(value).model_fields])
    elif isinstance(value, Mapping):
        yield from _secrets_in(value.values())
    elif isinstance(value, Iterable) and not isinstance(value, bytes):
        for one in value:
            yield from _secrets_in(one)
