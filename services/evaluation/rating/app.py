"""Application and routes of the rating page."""

from collections import Counter as Counts
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, FastAPI, Path, Request, Response
from prometheus_client import Counter, Gauge
from pydantic import Field

from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError
from dextouch.free_text import FreeLines
from dextouch.frozen_model import FrozenModel, example
from dextouch.serving import (
    RequireScope,
    ServedFolder,
    create_service_app,
    file_router,
    page_headers,
    serve,
)
from services.evaluation.rating import rating_queue
from services.evaluation.rating.invitations import Invitations, invitation_router
from services.evaluation.rating.marks import Judgement, Mark, MarkLog, RaterName
from services.evaluation.rating.rating_report import check_criteria, rating_report
from services.evaluation.rating.rubrics import Rubric, read_rubrics, rubric_of
from services.evaluation.settings import RatingSettings

STATIC: Final = FilePath(__file__).parent / "static"
FILES: Final = {"/": "rate.html", "/lead": "lead.html"} | {
    f"/{name}": name
    for name in ("rate.js", "rate.css", "rate.svg", "lead.js", "keys.js", "request.js")
}
Token = Annotated[str, Path(pattern=r"^[0-9a-f]{20}$")]


class CriterionView(FrozenModel):
    """A criterion as the page shows it."""

    name: str
    description: str
    latched: bool


class RolloutView(FrozenModel):
    """The next rollout of a rater; nothing names its policy or world."""

    rollout: str
    presentation: int
    task: str
    instruction: str
    criteria: tuple[CriterionView, ...]
    penalty: float
    num_steps: int
    rate_hz: float
    num_done: int
    num_open: int


class SubmittedMark(Judgement):
    """Body of a mark."""

    model_config = example(rollout="0123456789abcdef0123", rater="p07", holds={"touched": True})

    rollout: str = Field(pattern=r"^[0-9a-f]{20}$")
    comment: FreeLines = Field(default="", max_length=2000)


class SubmittedMarkNumber(FrozenModel):
    """Number of a stored mark."""

    number: int


def create_rating_app(settings: RatingSettings) -> FastAPI:
    """Create the application.

    Raises as `read_rubrics`, `rubric_of`, `rated_rollouts`, `check_criteria` and `MarkLog`.
    """
    rubrics = read_rubrics(settings.rubrics)
    tasks = settings.tasks or tuple(rubrics)
    for task in tasks:
        rubric_of(task, rubrics)
    store = EpisodeStore(settings.store_url).require_folder()
    marks = MarkLog(settings.marks)
    rollouts = rating_queue.rated_rollouts(store, tasks, study=settings.study)
    task_of = {one.episode_id: one.task for one in rollouts}
    check_criteria(marks.latest(), task_of, rubrics)
    queue = rating_queue.RatingQueue(
        rollouts,
        marks,
        raters_per_rollout=settings.raters_per_rollout,
        repeat_share=settings.repeat_share,
    )
    text = "Marks given since the start, with corrections."
    given = Counter("dextouch_rating_marks", text, registry=None)
    pictures = rating_queue.RolloutPictures(store)
    page = file_router(STATIC, FILES, page_headers(images="'self' blob:"))
    # Not the tasks that rubrics are for, of which a release may bring more.
    of_tasks = ", ".join(sorted(settings.tasks)) or "all tasks"
    pool = f"{settings.study or 'all rollouts'}, {of_tasks} of {store.root.resolve()}"
    invitations = Invitations(marks, pool)
    routers = [
        page,
        rating_router(queue, marks, rubrics, pictures, on_mark=given.inc),
        invitation_router(invitations),
        agreement_router(marks, task_of, rubrics, settings.raters_per_rollout),
    ]
    folders = [
        ServedFolder(store.root, "store folder", is_written=False),
        ServedFolder(settings.marks.parent, "folder of marks"),
    ]
    app = create_service_app(name="rating", settings=settings, routers=routers, folders=folders)
    app.state.registry.register(given)
    invitations.connect(app.state.access)
    text = "Rollouts that the service shows to raters."
    to_rate = Gauge("dextouch_rating_rollouts", text, registry=app.state.registry)
    to_rate.set(len(rollouts))
    return app


def rating_router(
    queue: rating_queue.RatingQueue,
    marks: MarkLog,
    rubrics: Mapping[str, Rubric],
    pictures: rating_queue.RolloutPictures,
    *,
    on_mark: Callable[[], object],
) -> APIRouter:
    """Router of assignments, pictures and marks."""
    needs_rater = RequireScope("rate")
    router = APIRouter(prefix="/v1/rating", tags=["rating"], dependencies=[Depends(needs_rater)])

    @router.get(
        "/next", response_model=None, responses={200: {"model": RolloutView}, 204: {}, 409: {}}
    )
    def get_next_rollout(
        request: Request, rater: RaterName, key: Annotated[str, Depends(needs_rater)]
    ) -> RolloutView | Response:
        """The rollout that a rater should rate next; 204 when nothing is left."""
        assigned = queue.next(_rater(request, rater, key))
        if assigned is None:
            return Response(status_code=204)
        rollout, rubric = assigned.rollout, rubric_of(assigned.rollout.task, rubrics)
        return RolloutView(
            rollout=rollout.token,
            presentation=assigned.presentation,
            task=rollout.task,
            instruction=rollout.instruction,
            criteria=tuple(
                CriterionView(name=one.name, description=one.description, latched=one.latched)
                for one in rubric.criteria
            ),
            penalty=rubric.penalty,
            num_steps=rollout.num_steps,
            rate_hz=rollout.rate_hz,
            num_done=assigned.num_done,
            num_open=assigned.num_open,
        )

    @router.get(
        "/rollouts/{token}/steps/{step}.jpg",
        response_class=Response,
        responses={200: {"content": {"image/jpeg": {}}}},
    )
    def get_step_image(token: Token, step: Annotated[int, Path(ge=0, le=100_000)]) -> Response:
        """Head image and taxel maps of one step."""
        jpeg = pictures.step(queue.rollout(token).episode_id, step)
        return Response(jpeg, media_type="image/jpeg", headers={"cache-control": "no-store"})

    @router.post("/marks", status_code=201)
    def submit_mark(
        request: Request, given: SubmittedMark, key: Annotated[str, Depends(needs_rater)]
    ) -> SubmittedMarkNumber:
        """Add a mark; a second one for the same presentation corrects the first."""
        rollout = queue.rollout(given.rollout)
        fields = given.model_dump(exclude={"rollout", "rater"})
        mark = Mark.model_validate(
            fields | {"rater": _rater(request, given.rater, key), "episode_id": rollout.episode_id}
        )
        queue.check(mark)
        if not mark.cannot_judge:
            rubric_of(rollout.task, rubrics).score(mark.holds)
        number = marks.add(mark)
        on_mark()
        return SubmittedMarkNumber(number=number)

    return router


def agreement_router(
    marks: MarkLog,
    task_of: Mapping[str, str],
    rubrics: Mapping[str, Rubric],
    raters_per_rollout: int,
) -> APIRouter:
    """Router of the agreement so far, which raters must not see."""
    leads = Depends(RequireScope("rate_lead"))
    router = APIRouter(prefix="/v1/rating", tags=["rating"], dependencies=[leads])

    @router.get("/agreement")
    def get_agreement() -> dict[str, Any]:
        """The report of all marks until now without single rollouts, with the rollouts by task."""
        given = marks.latest()
        report = rating_report(given, task_of, rubrics, {}, raters_per_rollout=raters_per_rollout)
        return report | {"rollouts": dict(Counts(task_of.values()))}

    return router


def _rater(request: Request, name: str, key: str) -> str:
    """The rater; with API keys they must have the key's name, so that nobody marks for another."""
    if request.app.state.access.has_keys and name != key:
        raise ConflictError(f"rater: got {name!r}, expected {key!r}, the name of this key")
    return name


def main(argv: Sequence[str]) -> int:
    """Serve the rating page until SIGINT or SIGTERM."""
    return serve("rating", RatingSettings, create_rating_app, argv)
