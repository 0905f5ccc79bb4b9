"""Page size limit of list routes."""

from dextouch.errors import LimitExceededError
from services.episode_store.filters import Page


def page_limit(page: Page, max_page: int) -> int:
    """Number of rows of a page; the maximum by default.

    Raises:
        LimitExceededError: above the maximum.
    """
    if page.limit is not None and page.limit > max_page:
        raise LimitExceededError(
            f"limit: got {page.limit}, expected at most {max_page}; "
            "ask for the next page with after=NEXT_AFTER",
            got=page.limit,
            expected=max_page,
        )
    return page.limit or max_page
