"""Command line of one station: `python -m services.acquisition`."""

import sys
from collections.abc import Sequence

from dextouch.serving import configure_logging, load_settings, run
from services.acquisition.app import create_app
from services.acquisition.memory import keep_for_life
from services.acquisition.settings import AcquisitionSettings


def main(argv: Sequence[str] | None = None) -> int:
    """Run the station until SIGINT or SIGTERM."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    settings = load_settings(AcquisitionSettings, arguments)
    configure_logging(
        service="acquisition", log_format=settings.log_format, level=settings.log_level
    )
    app = create_app(settings)
    keep_for_life()
    run(app, settings)
    return 0


if __name__ == "__main__":
    sys.exit(main())
