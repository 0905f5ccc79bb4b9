"""Building blocks of services: application factory, settings, logging, access, state, processes."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.serving.app import create_service_app as create_service_app
    from dextouch.serving.child_process import Answer as Answer
    from dextouch.serving.child_process import ChildProcess as ChildProcess
    from dextouch.serving.child_process import serve_parent as serve_parent
    from dextouch.serving.configuration_file import DATA as DATA
    from dextouch.serving.configuration_file import CommandSettings as CommandSettings
    from dextouch.serving.configuration_file import configuration_path as configuration_path
    from dextouch.serving.configuration_file import explained as explained
    from dextouch.serving.configuration_file import file_source as file_source
    from dextouch.serving.configuration_file import line_of as line_of
    from dextouch.serving.configuration_file import read_configuration as read_configuration
    from dextouch.serving.configuration_file import section_of as section_of
    from dextouch.serving.connections import timed as timed
    from dextouch.serving.guard import AS_SET as AS_SET
    from dextouch.serving.guard import FORM as FORM
    from dextouch.serving.guard import JSON as JSON
    from dextouch.serving.guard import KIB as KIB
    from dextouch.serving.guard import MSGPACK as MSGPACK
    from dextouch.serving.guard import OCTETS as OCTETS
    from dextouch.serving.guard import RequireScope as RequireScope
    from dextouch.serving.guard import media_type as media_type
    from dextouch.serving.guard import takes as takes
    from dextouch.serving.json_bodies import JsonBody as JsonBody
    from dextouch.serving.keys import AccessControl as AccessControl
    from dextouch.serving.keys import Grant as Grant
    from dextouch.serving.keys import not_signed_in as not_signed_in
    from dextouch.serving.keys import secret_digest as secret_digest
    from dextouch.serving.listening import bound_socket as bound_socket
    from dextouch.serving.logs import configure_logging as configure_logging
    from dextouch.serving.masking import masked as masked
    from dextouch.serving.refusals import WrongKeys as WrongKeys
    from dextouch.serving.running import MAX_WEBSOCKET_BYTES as MAX_WEBSOCKET_BYTES
    from dextouch.serving.running import check_address as check_address
    from dextouch.serving.running import run as run
    from dextouch.serving.running import serve as serve
    from dextouch.serving.running import server_options as server_options
    from dextouch.serving.served_folder import ServedFolder as ServedFolder
    from dextouch.serving.settings import ServiceSettings as ServiceSettings
    from dextouch.serving.settings import load_settings as load_settings
    from dextouch.serving.settings import service_config as service_config
    from dextouch.serving.spans import configure_spans as configure_spans
    from dextouch.serving.state import StateStore as StateStore
    from dextouch.serving.state import Versioned as Versioned
    from dextouch.serving.state import open_state as open_state
    from dextouch.serving.workers import run_workers as run_workers
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
