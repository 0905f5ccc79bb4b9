"""Logging configuration: one line per event, JSON in containers, coloured at a terminal."""

import logging
import sys
from typing import Final, Literal

import structlog
from structlog.typing import EventDict, Processor, WrappedLogger

from dextouch.free_text import printable
from dextouch.serving.masking import masked

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
