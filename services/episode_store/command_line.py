"""Command line `dextouch store`: inspect, repair and delete items of a store."""

from collections.abc import Callable, Sequence

from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore
from dextouch.free_text import printable
from dextouch.serving import configure_logging, load_settings
from services.episode_store.commands import Context, Outcome, change, inspect
from services.episode_store.parser import store_parser
from services.episode_store.settings import EpisodeStoreSettings


def main(argv: Sequence[str]) -> int:
    """Run a command of the store's command line.

    Returns:
        0; 1 if something is damaged, remains or is not provably deleted.
    """
    options = store_parser().parse_args(list(argv))
    # Items that the catalog leaves out are reported on stderr.
    configure_logging(service="episode_store", log_format="auto", level="warning")
    url = options.store or load_settings(EpisodeStoreSettings, []).store_url
    result, status = _COMMANDS[options.command](Context(EpisodeStore(url), url, options, _say))
    write_result(options.json, result)
    return status


def _say(line: str) -> None:
    print(printable(line))


_COMMANDS: dict[str, Callable[[Context], Outcome]] = {
    "list": inspect.list_items,
    "show": inspect.show,
    "verify": inspect.verify,
    "clicks": inspect.clicks,
    "delete": change.delete,
    "deletions": change.deletions,
    "restore": change.restore,
    "purge": change.purge,
    "repair": change.repair,
}
