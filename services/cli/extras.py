"""Optional extra that provides each package, for messages about missing ones."""

from dextouch.errors import DexTouchError, UnavailableError

# Import names; if several extras provide a package, the most relevant one has it.
_PACKAGES = {
    "store": "zarr zstandard google_crc32c av",
    "station": "serial fastcrc hid usb cv2",
    "serve": "fastapi uvicorn httptools rich redis httpx pydantic_settings structlog "
    "prometheus_client jinja2 websockets",
    "align": "scipy numba",
    "model": "torch safetensors PIL",
    "twin": "mujoco",
    "gym": "gymnasium",
    "export": "pyarrow mcap foxglove_schemas_protobuf numcodecs",
    "rerun": "rerun",
    "s3": "obstore",
}
EXTRA_OF = {package: extra for extra, names in _PACKAGES.items() for package in names.split()}


def install_hint(package: str) -> str:
    """The command that installs a package through its extra."""
    return f"pip install 'dextouch-wm[{EXTRA_OF[package]}]'"


def missing_package(error: ModuleNotFoundError, otherwise: str = "") -> DexTouchError | None:
    """Error for a missing package, with an alternative; None if no extra provides it."""
    package = (error.name or "").partition(".")[0]
    if package not in EXTRA_OF:
        return None
    return UnavailableError(
        f"the package {package!r} is not installed; {install_hint(package)}, or "
        f"'dextouch-wm[all]' for everything{otherwise}. `dextouch doctor` lists what is missing"
    )
