"""Building blocks of services: application factory, settings, logging, access, state, processes."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.serving.access import AccessControl as AccessControl
    from dextouch.serving.access import RequireScope as RequireScope
    from dextouch.serving.access import not_signed_in as not_signed_in
    from dextouch.serving.app import create_service_app as create_service_app
    from dextouch.serving.bodies import AS_SET as AS_SET
    from dextouch.serving.bodies import FORM as FORM
    from dextouch.serving.bodies import JSON as JSON
    from dextouch.serving.bodies import KIB as KIB
    from dextouch.serving.bodies import MSGPACK as MSGPACK
    from dextouch.serving.bodies import OCTETS as OCTETS
    from dextouch.serving.bodies import media_type as media_type
    from dextouch.serving.bodies import takes as takes
    from dextouch.serving.child_process import Answer as Answer
    from dextouch.serving.child_process import ChildProcess as ChildProcess
    from dextouch.serving.child_process import serve_parent as serve_parent
    from dextouch.serving.logs import configure_logging as configure_logging
    from dextouch.serving.middleware import timed as timed
    from dextouch.serving.settings import MAX_WEBSOCKET_BYTES as MAX_WEBSOCKET_BYTES
    from dextouch.serving.settings import ServiceSettings as ServiceSettings
    from dextouch.serving.settings import load_settings as load_settings
    from dextouch.serving.settings import run as run
    from dextouch.serving.settings import serve as serve
    from dextouch.serving.settings import server_options as server_options
    from dextouch.serving.settings import service_config as service_config
    from dextouch.serving.state import StateStore as StateStore
    from dextouch.serving.state import open_state as open_state
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
