"""Recorder of calibration takes at a running station, and questions to its operator."""

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, TypeVar

from dextouch.clients import Reply
from dextouch.command_line import progress
from dextouch.errors import NotFoundError

TICK_S = 0.1
# Timeout of an upload.
UPLOAD_S = 120.0

Found = TypeVar("Found")
Request = Callable[..., Reply]


class Question(NamedTuple):
    """Question to an operator, and how it can be answered.

    The answer starts `action`, such as "Record 10 s"; it is empty unless it `takes_text`. `choices`
    are other answers, each with what it does.
    """

    text: str
    action: str
    takes_text: bool = False
    choices: tuple[tuple[str, str], ...] = ()


Ask = Callable[[Question], str]


def ask_at_terminal(question: Question) -> str:
    """Put a question to the operator of a command."""
    others = "".join(f"; {does}: {answer or 'Enter alone'}" for does, answer in question.choices)
    how = "" if question.takes_text else "Enter: "
    return input(f"{question.text} ({how}{question.action}{others}) ")


class TakeRecorder:
    """Records takes with a station's recorder; interrupted and invalid ones are discarded.

    Args:
        request: sends a request to the station, as `HttpLink.request`.
        task: of the takes.
        spool: folder in which the station keeps its takes, if it is on this machine.
        store: store that the takes are uploaded to.
        is_practice: whether the devices are those to practise with, whose takes are not uploaded.
        wait: sleeps.
        announce: called with the duration of a take (s) when it begins.
    """

    def __init__(  # noqa: PLR0913 - all but two by name
        self,
        request: Request,
        task: str,
        *,
        spool: Path,
        store: str | None,
        is_practice: bool = False,
        wait: Callable[[float], None] = time.sleep,
        announce: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._request, self._task = request, task
        self._spool, self._store, self._is_practice = spool, store, is_practice
        self._wait, self._announce = wait, announce

    def record(
        self, name: str, words: str, seconds: float, check: Callable[[str], Found]
    ) -> tuple[str, Found]:
        """Record a valid take; interrupted and invalid ones are discarded.

        `words` are for the operator, and the take's instruction. `check` raises an error for an
        invalid take; of takes that are only in the store, after they are saved. Returns the take's
        folder in the spool, or its id in the store, and the result of the check. Raises
        ConflictError: the recorder is busy with another take; save or discard that.
        """
        self._act("arm", {"task": self._task, "instruction": words})
        self._act("record", {"recording_id": name})
        take, found = str((self._spool / name).resolve()), None
        with ExitStack() as undo:
            undo.callback(self._act, "discard", {"recording_id": name})
            self._announce(seconds)
            num_ticks = round(seconds / TICK_S)
            for _ in progress(range(num_ticks), words, num_ticks):
                self._wait(TICK_S)
            self._act("stop", {"recording_id": name})
            if Path(take).is_dir():
                found = check(take)
            undo.pop_all()
        # Other devices may be absent; `check` sees whether the needed ones are there.
        self._act("save", {"recording_id": name, "accept_incomplete": True})
        if found is None:
            take = self._await_upload(name)
            found = check(take)
        return take, found

    def _act(self, action: str, body: dict[str, object]) -> None:
        self._request("POST", f"/v1/recorder/{action}", body=json.dumps(body).encode())

    def _await_upload(self, name: str) -> str:
        """Wait for the upload and return the take's id in the store."""
        if self._is_practice:
            raise NotFoundError(
                f"take {name!r}: not in {self._spool.resolve()}, and takes of practice devices are "
                "not uploaded; run the alignment service on the station's machine, with "
                "--station-spool of the station's own spool (DEXTOUCH_ALIGNMENT_STATION_SPOOL)"
            )
        if self._store is None:
            raise NotFoundError(
                f"take {name!r}: not in {self._spool.resolve()}; name the station's spool "
                "with --spool, or on another machine its store with --store URL"
            )
        num_tries = round(UPLOAD_S)
        for _ in progress(range(num_tries), "waiting for the upload", num_tries):
            uploads = json.loads(self._request("GET", "/v1/uploads").body)
            for take in uploads:
                if take["recording_id"] == name and take["uploaded"]:
                    return str(take.get("stored_as") or name)
            self._wait(1.0)
        raise NotFoundError(
            f"take {name!r}: the station did not upload it within {UPLOAD_S:g} s; look at its "
            "uploads, then calibrate from the recording in the store"
        )
