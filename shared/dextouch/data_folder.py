"""Default data folder of all commands: `data`, or the folder named by DEXTOUCH_DATA."""

import os
from pathlib import Path

from dextouch.errors import InvalidInputError

DATA_VARIABLE = "DEXTOUCH_DATA"


def data_folder() -> Path:
    """The folder below which commands keep their data unless a flag says otherwise.

    Raises:
        InvalidInputError: the variable holds a URL.
    """
    text = os.environ.get(DATA_VARIABLE) or "data"
    if "://" in text:
        raise InvalidInputError(
            f"{DATA_VARIABLE}: got {text!r}, expected a local folder; name a store in a bucket "
            "with --store or the service's store_url"
        )
    return Path(text).expanduser()


def default_store() -> str:
    """Where episodes and recordings are kept."""
    return str(data_folder() / "store")


def default_enrolment() -> Path:
    """Where an enrolled station keeps its key of the store."""
    return data_folder() / "enrolment.json"


def default_spool() -> Path:
    """Where a station keeps its takes until they are uploaded."""
    return data_folder() / "spool"
