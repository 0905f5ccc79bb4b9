"""Optional extra that provides each package, for messages about missing ones."""

from dextouch.errors import DexTouchError, UnavailableError

# By import name; if several extras provide a package, the most relevant one.
EXTRA_OF = {
    "zarr": "store",
    "zstandard": "store",
    "google_crc32c": "store",
    "av": "store",
    "serial": "station",
    "fastcrc": "station",
    "hid": "station",
    "usb": "station",
    "cv2": "station",
    "fastapi": "serve",
    "uvicorn": "serve",
    "httptools": "serve",
    "rich": "serve",
    "redis": "serve",
    "httpx": "serve",
    "pydantic_settings": "serve",
    "structlog": "serve",
    "prometheus_client": "serve",
    "jinja2": "serve",
    "websockets": "serve",
    "scipy": "align",
    "numba": "align",
    "torch": "model",
    "safetensors": "model",
    "PIL": "model",
    "mujoco": "twin",
    "gymnasium": "gym",
    "pyarrow": "export",
    "mcap": "export",
    "foxglove_schemas_protobuf": "export",
    "numcodecs": "export",
    "rerun": "rerun",
    "obstore": "s3",
}


def install_hint(package: str) -> str:
    """The command that installs a package through its extra."""
    return f"pip install 'dextouch-wm[{EXTRA_OF[package]}]'"


def missing_package(error: ModuleNotFoundError, otherwise: str = "") -> DexTouchError | None:
    """Error for a missing package; None if no extra provides it.

    Args:
        error: error of the import.
        otherwise: alternative to mention in the message.
    """
    package = (error.name or "").partition(".")[0]
    if package not in EXTRA_OF:
        return None
    return UnavailableError(
        f"the package {package!r} is not installed; {install_hint(package)}, or "
        f"'dextouch-wm[all]' for everything{otherwise}. `dextouch doctor` lists what is missing"
    )
