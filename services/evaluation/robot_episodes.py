"""Selection of robot episodes for training the networks of the evaluation."""

from collections.abc import Callable, Iterator, Sequence

from dextouch.episodes import EpisodeReader, EpisodeStore, is_rejected
from dextouch.errors import ConflictError, NotFoundError
from dextouch.schemas import EpisodeAttributes


def robot_episodes(
    stores: Sequence[EpisodeStore],
    *,
    tasks: Sequence[str] = (),
    wanted: Callable[[EpisodeAttributes], bool] | None = None,
    what: str = "robot episode",
) -> Iterator[EpisodeReader]:
    """Iterate over robot episodes, store by store in the order of their ids.

    Those that were rejected in review are left out.

    Args:
        stores: stores to read.
        tasks: tasks to read; empty for all.
        wanted: predicate on the attributes of an episode; default: all episodes.
        what: what is read, for error messages.

    Raises:
        NotFoundError: no such episode, or an empty store.
        ConflictError: two stores hold an episode of the same id.
    """
    found: set[str] = set()
    num_rejected = 0
    for place, store in enumerate(stores, 1):
        names = sorted(store.list(kind="episode"))
        if not names:
            raise NotFoundError(f"store {place} of {len(stores)}: has no episode; check its path")
        for episode_id in names:
            reader = store.open(episode_id)
            about = reader.attributes
            if about.domain != "robot" or (tasks and about.task not in tasks):
                continue
            if wanted is not None and not wanted(about):
                continue
            if is_rejected(store, about):
                num_rejected += 1
                continue
            if episode_id in found:
                raise ConflictError(f"episode {episode_id!r}: in two stores; pass only one of them")
            found.add(episode_id)
            yield reader
    if not found:
        raise NotFoundError(
            f"no {what} of {', '.join(tasks) or 'any task'} in the stores"
            f"{f' but {num_rejected} that were rejected in review' if num_rejected else ''}; "
            "record some with `dextouch train data` first"
        )
