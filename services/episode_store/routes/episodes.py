"""Episodes over HTTP: the catalog, attributes, windows and samples of streams."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response

from dextouch.schemas.episodes import Domain, EpisodeDetail, EpisodeList, Origin
from dextouch.schemas.rollouts import ActionKind
from dextouch.serving.access import RequireScope
from services.episode_store.catalog import Catalog, EpisodeFilter
from services.episode_store.reading import MSGPACK, StoreReader

READ_SCOPE = "store_read"


def episodes_router(*, catalog: Catalog, reader: StoreReader, max_page: int) -> APIRouter:
    """Routes under /v1/episodes."""
    router = APIRouter(
        prefix="/v1/episodes",
        tags=["episodes"],
        dependencies=[Depends(RequireScope(READ_SCOPE))],
    )

    @router.get("")
    def listing(
        wanted: Annotated[EpisodeFilter, Depends(_filter)],
        limit: int = Query(default=max_page, ge=1, le=max_page),
        offset: int = Query(default=0, ge=0),
    ) -> EpisodeList:
        """Episodes that match every given filter."""
        return catalog.episodes(wanted, limit=limit, offset=offset)

    @router.get("/{episode_id}")
    def detail(episode_id: str) -> EpisodeDetail:
        """What an episode says about itself."""
        return reader.episode(episode_id)

    @router.get("/{episode_id}/windows")
    def window(
        episode_id: str,
        start: int = Query(ge=0),
        num_steps: int = Query(default=17, ge=1),
        cameras: str = Query(default="camera_head", description="names, with commas between"),
        action_kind: ActionKind = "measured",
    ) -> Response:
        """Steps of the model grid as msgpack (`dextouch.episodes.window_codec`)."""
        names = tuple(name for name in cameras.split(",") if name)
        data = reader.window(episode_id, start, num_steps, cameras=names, action_kind=action_kind)
        return Response(data, media_type=MSGPACK)

    @router.get("/{episode_id}/streams/{stream}")
    def samples(
        episode_id: str, stream: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Response:
        """Samples with start_ns ≤ t_ref_ns < stop_ns as msgpack."""
        data = reader.episode_samples(episode_id, stream, start_ns, stop_ns)
        return Response(data, media_type=MSGPACK)

    return router


def _filter(
    task: str | None = None,
    domain: Domain | None = None,
    origin: Origin | None = None,
    success: bool | None = None,  # noqa: FBT001 - a query parameter
) -> EpisodeFilter:
    return EpisodeFilter(task=task, domain=domain, origin=origin, success=success)
