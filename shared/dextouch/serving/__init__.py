"""Building blocks of services: application factory, settings, logging, access, state, processes."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.serving.access import AccessControl, RequireScope, not_signed_in
    from dextouch.serving.app import create_service_app
    from dextouch.serving.bodies import AS_SET, FORM, JSON, KIB, MSGPACK, OCTETS, media_type, takes
    from dextouch.serving.child_process import Answer, ChildProcess, serve_parent
    from dextouch.serving.logs import configure_logging
    from dextouch.serving.middleware import timed
    from dextouch.serving.settings import (
        MAX_WEBSOCKET_BYTES,
        ServiceSettings,
        load_settings,
        run,
        service_config,
    )
    from dextouch.serving.state import StateStore, open_state
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "access": "AccessControl RequireScope not_signed_in",
            "app": "create_service_app",
            "bodies": "AS_SET FORM JSON KIB MSGPACK OCTETS media_type takes",
            "child_process": "Answer ChildProcess serve_parent",
            "logs": "configure_logging",
            "middleware": "timed",
            "settings": "MAX_WEBSOCKET_BYTES ServiceSettings load_settings run service_config",
            "state": "StateStore open_state",
        },
    )

__all__ = [
    "AS_SET",
    "FORM",
    "JSON",
    "KIB",
    "MAX_WEBSOCKET_BYTES",
    "MSGPACK",
    "OCTETS",
    "AccessControl",
    "Answer",
    "ChildProcess",
    "RequireScope",
    "ServiceSettings",
    "StateStore",
    "configure_logging",
    "create_service_app",
    "load_settings",
    "media_type",
    "not_signed_in",
    "open_state",
    "run",
    "serve_parent",
    "service_config",
    "takes",
    "timed",
]
