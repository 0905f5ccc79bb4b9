"""Independent jobs, in processes of this machine or on a Ray cluster.

Jobs must be repeatable, since that of a worker process which is killed is repeated: what they
write is written at once and under a name that the item decides, as episodes are.
"""

import multiprocessing
import os
import secrets
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Generic, TypeVar, cast

import structlog

from dextouch.episodes import disk_errors
from dextouch.errors import ConflictError, DexTouchError, NotFoundError, UnavailableError

logger = structlog.get_logger(__name__)

# Chosen: of the jobs that ran when a worker was killed, some had not even begun.
_TRIES_ALONE: Final = 2
# Chosen: machines of a cluster may go away more than once during a long job.
_RAY_RETRIES: Final = 3
# Jobs that wait at a Ray cluster: enough that no worker idles, few enough that the driver's memory
# does not grow with the number of items.
_MAX_SUBMITTED: Final = 1000

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """Where jobs run.

    Attributes:
        num_processes: processes of this machine; with one, jobs run in this process.
        ray_address: of a Ray cluster, which is then used instead: `auto`, `ray://HOST:10001`, or
            `local` for one on this machine.
    """

    num_processes: int = 1
    ray_address: str | None = None


@dataclass(frozen=True)
class Job(Generic[Item, Result]):
    """A job that ended: its item, and its result or its error."""

    item: Item
    value: Result | None = None
    error: DexTouchError | None = None

    def result(self) -> Result:
        """The result; raises the error of a job that failed."""
        if self.error is not None:
            raise self.error
        # None may be a result.
        return cast(Result, self.value)


def run_jobs(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    workers: Workers,
    *,
    prepare: Callable[[], object] | None = None,
    folders: Sequence[str | Path] = (),
) -> Iterator[Job[Item, Result]]:
    """Call a function for each item and yield what comes of it, in the order in which jobs end.

    A `DexTouchError` is the error of its job; any other exception ends the run. A job whose worker
    is killed is repeated: on this machine up to twice, after all others and alone, so that only the
    one that kills its worker fails; on a cluster three times. The function and the items are
    pickled; `prepare` is called once in each worker process. Jobs write to `folders` of this
    machine: on a cluster, machines that do not see them refuse their jobs.

    Raises:
        UnavailableError: there is no cluster at the address.
    """
    if workers.ray_address is not None:
        with _marked(folders) as marks:
            yield from _on_ray(
                (function, prepare, _Here(marks, version("dextouch-wm"), Path.cwd())),
                items,
                workers.ray_address,
            )
    elif workers.num_processes == 1 or len(items) < 2:
        for item in items:
            yield Job(item, *_attempt(function, None, None, item))
    else:
        call = partial(_attempt, function, None, None)
        yield from _in_processes(call, items, workers.num_processes, prepare)


def results_of(jobs: Iterable[Job[Any, Result]]) -> Iterator[Result]:
    """Results as jobs end; errors are logged, and the first is raised once all jobs have ended."""
    errors = []
    for job in jobs:
        if job.error is None:
            yield job.result()
        else:
            logger.warning("job_failed", reason=job.error.message)
            errors.append(job.error)
    if errors:
        raise errors[0]


Ending = tuple[Any, DexTouchError | None]


def _in_processes(
    call: Callable[[Item], Ending],
    items: Sequence[Item],
    num_processes: int,
    prepare: Callable[[], object] | None,
) -> Iterator[Job[Item, Any]]:
    todo, suspects = list(reversed(items)), list[Item]()
    while todo:
        running: dict[Future[Ending], Item] = {}
        with worker_pool(min(num_processes, len(todo)), prepare) as pool:
            is_broken = False
            while running or (todo and not is_broken):
                # No more than there are workers: those of a broken pool are the suspects.
                while todo and not is_broken and len(running) < num_processes:
                    try:
                        future = pool.submit(call, todo[-1])
                    except BrokenProcessPool:
                        is_broken = True
                    else:
                        running[future] = todo.pop()
                ended = wait(running, return_when=FIRST_COMPLETED).done
                for future in ended:
                    item = running.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        is_broken = True
                        suspects.append(item)
                    else:
                        yield Job(item, *future.result())
    for item in suspects:
        yield Job(item, *_alone(call, item, prepare))


def _alone(
    call: Callable[[Item], Ending], item: Item, prepare: Callable[[], object] | None
) -> Ending:
    for _ in range(_TRIES_ALONE):
        with worker_pool(1, prepare) as pool:
            future = pool.submit(call, item)
            if not isinstance(future.exception(), BrokenProcessPool):
                return future.result()
    return None, _lost(f"again and again, {_TRIES_ALONE} times without other jobs beside it")


def _on_ray(
    call: tuple[object, ...], items: Sequence[Item], address: str
) -> Iterator[Job[Item, Any]]:
    """Jobs on a cluster; `call` are the arguments of `_attempt` before the item."""
    import ray
    from ray.exceptions import RayError, RayTaskError

    with _connected(address):
        remote = ray.remote(_attempt).options(num_cpus=1, max_retries=_RAY_RETRIES)
        todo, running = list(reversed(items)), dict[Any, Item]()
        while todo or running:
            while todo and len(running) < _MAX_SUBMITTED:
                item = todo.pop()
                running[remote.remote(*call, item)] = item
            (reference,), _ = ray.wait(list(running), num_returns=1)
            item = running.pop(reference)
            try:
                yield Job(item, *ray.get(reference))
            except RayTaskError as error:
                raise error.cause from error
            except RayError as error:
                times = f"{1 + _RAY_RETRIES} times ({str(error).splitlines()[0]})"
                yield Job(item, None, _lost(times))


@contextmanager
def _connected(address: str) -> Iterator[None]:
    import ray

    if ray.is_initialized():
        yield
        return
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error")
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UnavailableError(
            f"Ray cluster {address}: cannot be reached ({error}); start it with "
            "`ray start --head`, or check the address"
        ) from error
    try:
        yield
    finally:
        # Ends the jobs that still run, as after Ctrl-C.
        ray.shutdown()


def _lost(times: str) -> UnavailableError:
    return UnavailableError(
        f"the worker process was killed {times}; it may have needed more memory than there is"
    )


@cache
def _prepared(prepare: Callable[[], object]) -> None:
    prepare()


def _attempt(
    function: Callable[[Item], Result],
    prepare: Callable[[], object] | None,
    here: "_Here | None",
    item: Item,
) -> Ending:
    """Result and error of one call, in a worker that must see what is `here`."""
    try:
        if here is not None:
            here.enter()
        if prepare is not None:
            _prepared(prepare)
        return function(item), None
    except DexTouchError as error:
        return None, error


@dataclass(frozen=True)
class _Here:
    """What machines of a cluster must share with the one that orders their jobs."""

    marks: tuple[Path, ...]
    version: str
    folder: Path

    def enter(self) -> None:
        """Work in the same folder, so that relative paths mean the same files.

        Raises NotFoundError for a folder that this machine does not see, ConflictError for another
        version.
        """
        machine = os.uname().nodename
        missing = [mark.parent for mark in self.marks if not mark.exists()]
        missing += [] if self.folder.is_dir() else [self.folder]
        if missing:
            raise NotFoundError(
                f"{machine}: does not see the folder {missing[0]} of the machine that ordered the "
                "job; mount it on all machines of the cluster, run the command in a folder that "
                "all have, or use a store at s3://…"
            )
        if (got := version("dextouch-wm")) != self.version:
            raise ConflictError(
                f"{machine}: has dextouch-wm {got}, expected {self.version} as on the machine that "
                "ordered the job; install the same version on all machines of the cluster"
            )
        os.chdir(self.folder)


@contextmanager
def _marked(folders: Sequence[str | Path]) -> Iterator[tuple[Path, ...]]:
    """Files in these folders while the block lasts, by which other machines recognize them."""
    name = f".jobs-{secrets.token_hex(8)}"
    with ExitStack() as cleaning:
        marks = []
        for folder in folders:
            mark = Path(folder).absolute() / name
            with disk_errors(f"write {mark}"):
                mark.parent.mkdir(parents=True, exist_ok=True)
                mark.touch()
            cleaning.callback(mark.unlink, missing_ok=True)
            marks.append(mark)
        yield tuple(marks)


@contextmanager
def worker_pool(
    num_workers: int, prepare: Callable[[], object] | None = None
) -> Iterator[ProcessPoolExecutor]:
    """Fresh interpreters, which share no threads and locks with this process.

    If the block fails, waiting jobs are cancelled. If this process is killed, its workers end at
    once; those of a bare pool would go on with their jobs. `prepare`, picklable, is called in each.
    """
    spawned = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(num_workers, spawned, _begin, (prepare,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(prepare: Callable[[], object] | None) -> None:
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    if prepare is not None:
        prepare()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
