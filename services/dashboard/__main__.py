"""Entry point `python -m services.dashboard`, which serves the operators' page."""

import sys
from collections.abc import Sequence

from dextouch.serving import configure_logging, load_settings, run
from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings


def main(argv: Sequence[str] | None = None) -> int:
    """Serve the dashboard until SIGINT or SIGTERM."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    settings = load_settings(DashboardSettings, arguments)
    configure_logging(service="dashboard", log_format=settings.log_format, level=settings.log_level)
    run(create_app(settings), settings)
    return 0


if __name__ == "__main__":
    sys.exit(main())
