"""Settings of the service of studies."""

from pathlib import Path

from pydantic import Field

from dextouch.data_folder import data_folder
from dextouch.serving import ServiceSettings, service_config


class StudyServiceSettings(ServiceSettings):
    """Serve the results of studies over HTTP, for the dashboard.

    Reads only: studies are run by `dextouch study run`, and may run meanwhile.

    Example:
      dextouch study serve --studies data/studies --port 8086
    """

    model_config = service_config("studies", "dextouch study serve")

    studies: Path = Field(
        default_factory=lambda: data_folder() / "studies",
        description="folder that holds the folder of each study",
    )
