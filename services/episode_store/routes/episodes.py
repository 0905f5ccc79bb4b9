"""Routes of /v1/episodes: list, attributes, windows and samples."""

from typing import Annotated

from fastapi import APIRouter, Header, Query, Response

from dextouch.schemas import EpisodeDetail, EpisodeList
from services.episode_store.catalog import Catalog
from services.episode_store.filters import EpisodeQuery
from services.episode_store.reading import SpanQuery, StoreReader, WindowQuery
from services.episode_store.routes.media import MSGPACK, WINDOW_MSGPACK, as_response, chosen_type
from services.episode_store.routes.scopes import MAY_READ


def episodes_router(*, catalog: Catalog, reader: StoreReader, max_page: int) -> APIRouter:
    """Create the router."""
    router = APIRouter(prefix="/v1/episodes", tags=["episodes"], dependencies=[MAY_READ])

    @router.get("")
    def listing(wanted: Annotated[EpisodeQuery, Query()]) -> EpisodeList:
        """List episodes that match all filters."""
        limit = wanted.num_rows(max_page)
        return catalog.episodes(wanted, limit=limit, offset=wanted.offset, after=wanted.after)

    @router.get("/{episode_id}")
    def detail(episode_id: str) -> EpisodeDetail:
        """Attributes of an episode."""
        return reader.episode(episode_id)

    @router.get("/{episode_id}/windows")
    def window(
        episode_id: str,
        query: Annotated[WindowQuery, Query()],
        accept: Annotated[str | None, Header()] = None,
        if_none_match: Annotated[str | None, Header()] = None,
    ) -> Response:
        """Window of the model grid as msgpack (`dextouch.episodes.decode_window`)."""
        media_type = chosen_type(accept, (WINDOW_MSGPACK, MSGPACK))
        return as_response(reader.window(episode_id, query, known=if_none_match), media_type)

    @router.get("/{episode_id}/streams/{stream}")
    def samples(
        episode_id: str,
        stream: str,
        span: Annotated[SpanQuery, Query()],
        if_none_match: Annotated[str | None, Header()] = None,
    ) -> Response:
        """Samples with start_ns ≤ t_ref_ns < stop_ns as msgpack."""
        answer = reader.samples("episode", episode_id, stream, span, known=if_none_match)
        return as_response(answer, MSGPACK)

    return router
