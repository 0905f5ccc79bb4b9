"""Entry point `python -m benchmarks STAGE`, run in a checkout; prints errors as one line."""

import sys
from collections.abc import Sequence

from dextouch.command_line import messages_aside
from dextouch.errors import DexTouchError
from services.cli.extras import missing_package
from services.cli.main import EXIT_REFUSED

EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark of one stage; 3 for a refusal or a missing package, told on stderr."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        from benchmarks import command

        with messages_aside(arguments):
            return command.main(arguments)
    except ModuleNotFoundError as error:
        refusal = missing_package(error)
        if refusal is None:
            raise
    except DexTouchError as error:
        refusal = error
    except KeyboardInterrupt:
        print("benchmarks: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    print(f"benchmarks: {refusal.message}", file=sys.stderr)
    return EXIT_REFUSED


if __name__ == "__main__":
    sys.exit(main())
