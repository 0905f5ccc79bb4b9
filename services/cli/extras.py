"""Extras of the package: which of them brings a package that is not installed."""

from dextouch.errors import DexTouchError, UnavailableError
from dextouch.installation import install_command

# Import names; if several extras provide a package, the most relevant one has it.
_PACKAGES = {
    "store": "zarr zstandard google_crc32c av structlog",
    "station": "serial fastcrc hid hidraw usb cv2",
    "serve": "fastapi uvicorn uvloop httptools rich redis httpx pydantic_settings "
    "prometheus_client jinja2 markdown_it PIL websockets shtab",
    "align": "scipy numba",
    "model": "torch safetensors",
    "full": "diffusers transformers",
    "twin": "mujoco",
    "gym": "gymnasium",
    "export": "pyarrow mcap mcap_ros2 lz4 foxglove_schemas_protobuf google",
    "rerun": "rerun",
    "s3": "obstore",
    "scale": "ray",
}
_NOT_IN_ALL = ("full", "rerun", "scale")
EXTRA_OF = {package: extra for extra, names in _PACKAGES.items() for package in names.split()}


def install_hint(package: str) -> str:
    """The command that installs a package through its extra."""
    return install_command(EXTRA_OF[package])


def missing_package(error: ModuleNotFoundError, otherwise: str = "") -> DexTouchError | None:
    """Error for a missing package, with an alternative; None if no extra provides it."""
    package = (error.name or "").partition(".")[0]
    if package not in EXTRA_OF:
        return None
    hint = f"`{install_hint(package)}` installs it"
    if EXTRA_OF[package] not in _NOT_IN_ALL:
        hint += ", the extra 'all' everything"
    return UnavailableError(
        f"the package {package!r} is not installed; {hint}{otherwise}. "
        "`dextouch doctor` lists what is missing"
    )
