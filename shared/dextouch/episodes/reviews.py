"""What people say of stored items, kept beside their content: reviews, and clicks on objects.

Each is a file of the item's group. It is no part of the content, so it may change, and it goes
where the item goes: to the trash, back, and away for good.
"""

from typing import Final, TypeVar

from pydantic import BaseModel, ValidationError

from dextouch.episodes.sources import GroupFiles
from dextouch.errors import CorruptDataError

REVIEW_FILE: Final = "review.json"
CLICKS_FILE: Final = "clicks.json"
# All files beside the content.
REMARK_FILES: Final = (REVIEW_FILE, CLICKS_FILE)

Remark = TypeVar("Remark", bound=BaseModel)


def read_remark(files: GroupFiles, name: str, form: type[Remark], *, what: str) -> Remark | None:
    """A file beside the content of a group; None if there is none.

    Raises:
        CorruptDataError: the file has another form.
    """
    content = files.get(name)
    if content is None:
        return None
    try:
        return form.model_validate_json(content, extra="ignore")
    except ValidationError as error:
        raise CorruptDataError(
            f"{what}: {name} is no {name.removesuffix('.json')} ({error.error_count()} fields do "
            "not fit); delete the file, and enter it again"
        ) from error
