"""Reviews of stored items: whether a person accepted or rejected one, kept beside its content.

A review is the file `review.json` of the item's group. It is no part of the content, so it may
change, and it goes where the item goes: to the trash, back, and away for good.
"""

from pydantic import ValidationError

from dextouch.episodes.sources import GroupFiles
from dextouch.errors import CorruptDataError
from dextouch.schemas import Review

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
