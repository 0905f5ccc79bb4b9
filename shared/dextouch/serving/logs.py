"""Logging: one line per event, JSON in containers, coloured at a terminal, without secrets.

No message is meant to contain a key or password. They are masked for those that a client sends in
the wrong place, such as the path of a URL, and for texts of libraries.
"""

import json
import logging
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from typing import Final, Literal
from urllib.parse import quote, urlsplit

import structlog
from pydantic import BaseModel, SecretStr
from structlog.typing import EventDict, Processor, WrappedLogger

from dextouch.free_text import printable

# Libraries that log headers, in which keys are sent, or every request.
QUIET: Final = {"httpx": "WARNING", "httpcore": "INFO", "websockets": "INFO", "uvicorn": "INFO"}


def configure_logging(
    *, service: str, log_format: Literal["auto", "json", "console"], level: str
) -> None:
    """Route structlog and the standard library's loggers (uvicorn) to stderr in one format.

    `service` is bound to every event; auto is console when stderr is a terminal, JSON otherwise.
    """
    console = log_format == "console" or (log_format == "auto" and sys.stderr.isatty())
    shared: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    last: list[Processor] = (
        # Plain tracebacks: rich ones print local variables, which may contain keys.
        [
            structlog.processors.format_exc_info,
            _escape,
            structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
            ),
        ]
        if console
        else [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    )
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=False,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                *last,
                lambda _, __, line: masked(str(line)),
            ],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for name, least in QUIET.items():
        logging.getLogger(name).setLevel(max(level.upper(), least, key=logging.getLevelName))
    logging.getLogger("uvicorn.error").addFilter(_is_wanted)
    structlog.contextvars.bind_contextvars(service=service)


def _escape(_: WrappedLogger, __: str, event: EventDict) -> EventDict:
    """For the console: no text forges a line or changes the terminal. JSON has its own escapes."""
    # A traceback and the stack are texts of several lines.
    return {
        name: printable(one, lines=name in {"exception", "stack"}) if isinstance(one, str) else one
        for name, one in event.items()
    }


def _is_wanted(record: logging.LogRecord) -> bool:
    """False for some of uvicorn's lines.

    Those about WebSockets hold the query, and so maybe a key; bytes that are no request are noted
    as `request_refused`, with the client and limited in number.
    """
    text = str(record.msg)
    return '"WebSocket %s"' not in text and text != "Invalid HTTP request received."


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
