"""Reviews of stored items: whether a person accepted or rejected one, kept beside its content.

A review is the file `review.json` of the item's group. It is no part of the content, so it may
change, and it goes where the item goes: to the trash, back, and away for good.
"""

from typing import TYPE_CHECKING

from pydantic import ValidationError

from dextouch.episodes.format import KINDS
from dextouch.episodes.sources import GroupFiles
from dextouch.errors import CorruptDataError
from dextouch.schemas import EpisodeAttributes, Review

if TYPE_CHECKING:
    from dextouch.episodes.store import EpisodeStore

REVIEW_FILE = "review.json"


def read_review(files: GroupFiles, *, what: str) -> Review | None:
    """The review of a group; None if nobody reviewed it.

    Raises:
        CorruptDataError: the file is no review.
    """
    content = files.get(REVIEW_FILE)
    if content is None:
        return None
    try:
        return Review.model_validate_json(content, extra="ignore")
    except ValidationError as error:
        raise CorruptDataError(
            f"{what}: {REVIEW_FILE} is no review ({error.error_count()} fields do not fit); "
            "delete the file, then review the item again"
        ) from error


def is_rejected(store: "EpisodeStore", about: EpisodeAttributes) -> bool:
    """Whether an episode must not be trained on.

    An episode is rejected by its own review; one without a review is rejected with a recording or
    episode that it was made from, if that is in the same store.
    """
    own = store.review(about.episode_id)
    if own is not None:
        return own.verdict == "rejected"
    for source in about.lineage:
        for kind in KINDS:
            if source.kind == kind and store.exists(source.id, kind=kind):
                review = store.review(source.id, kind=kind)
                if review is not None and review.verdict == "rejected":
                    return True
    return False
