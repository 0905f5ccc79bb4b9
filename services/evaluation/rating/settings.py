"""Settings of the rating commands."""

from pathlib import Path

from pydantic import Field

from dextouch.command_line import JSON_HELP
from dextouch.data_folder import default_store
from dextouch.serving import CommandSettings, ServiceSettings, service_config

DEFAULT_MARKS = Path("runs/ratings.sqlite")
_MARKS = "append-only SQLite file of the marks"
_STUDY = "name of the study whose rollouts are rated; default: all rollouts of the store"
_RUBRICS = "TOML file of rubrics by task; default: the package's"


class RatingSettings(ServiceSettings):
    """Serve a page on which people rate the rollouts of a store, without knowing their origin.

    Every rater sees the rollouts in a different order, without policy, world or the marks of
    others, and some of them twice. With API keys, a rater is the name of a key with the scope
    `rate`.

    Example:
      dextouch rate serve --store-url runs/rollouts --marks runs/ratings.sqlite --port 8087
    """

    model_config = service_config("rating", "dextouch rate serve")

    store_url: str = Field(
        default_factory=default_store, min_length=1, description="folder or file:// URL"
    )
    marks: Path = Field(default=DEFAULT_MARKS, description=_MARKS)
    rubrics: Path | None = Field(default=None, description=_RUBRICS)
    tasks: tuple[str, ...] = Field(
        default=(), description="tasks to rate; default: all that have a rubric"
    )
    study: str | None = Field(default=None, min_length=1, description=_STUDY)
    raters_per_rollout: int = Field(
        default=5, ge=1, le=100, description="number of people who rate each rollout"
    )
    repeat_share: float = Field(
        default=0.08, ge=0, le=0.5, description="share of rollouts that a rater sees twice"
    )


class RatingReportSettings(CommandSettings):
    """Print the scores of the rated rollouts of a store, and the agreement of raters.

    Example:
      dextouch rate report --store-url runs/rollouts --marks runs/ratings.sqlite --json ratings.json
    """

    model_config = service_config("rating_report", "dextouch rate report")

    store_url: str = Field(
        default_factory=default_store, min_length=1, description="folder or file:// URL"
    )
    marks: Path = Field(default=DEFAULT_MARKS, description=_MARKS)
    rubrics: Path | None = Field(default=None, description=_RUBRICS)
    study: str | None = Field(default=None, min_length=1, description=_STUDY)
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)
