"""Devices behind a server at a TCP address: its settings, and the transport to it."""

from pydantic import Field

from services.acquisition.devices.kind import DeviceSettings
from services.acquisition.transports.socket import SocketTransport, tcp_connector


class TcpSettings(DeviceSettings):
    """A device at a TCP address."""

    host: str = "127.0.0.1"
    port: int = Field(gt=0, le=65535)


def tcp_transport(settings: TcpSettings) -> SocketTransport:
    """The connection to it, not opened."""
    address = f"{settings.host}:{settings.port}"
    return SocketTransport(tcp_connector(settings.host, settings.port), address=address)
