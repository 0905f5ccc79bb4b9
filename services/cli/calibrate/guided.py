"""Guided glove calibration: leads an operator through takes recorded by a running station."""

import argparse
import json
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from dextouch.clients import HttpLink, Reply
from dextouch.command_line import progress
from dextouch.errors import InvalidInputError, NotFoundError, UnknownNameError
from services.alignment.calibration.tactile_gain import TaxelPress, fit_gain
from services.alignment.calibration.tactile_glove_calibration import calibrate_glove, pad_taxels
from services.alignment.calibration.tactile_tare import TaxelTare, measure_tare
from services.cli.calibrate.glove_takes import PressRow, press_of, read_take, write_presses

REST_S, PRESS_S, TICK_S = 10.0, 5.0, 0.1
# Timeout of an upload.
UPLOAD_S = 120.0
TASK = "calibrate-glove"
PRESS_HELP = "30, or 30 palm, or 30 thumb+index (kPa), or 2kg/90cm2 palm (a weight)"
NEXT = "Next pressure (Enter alone: no more; drop: forget the last): "
# Groups are named as the columns of the list of presses.
_PRESS = re.compile(
    r"(?:(?P<pressure_kpa>[0-9.]+)(?: ?kpa)?"
    r"|(?P<mass_kg>[0-9.]+) ?kg ?/ ?(?P<area_cm2>[0-9.]+) ?cm2)(?: +(?P<pads>[a-z+]+))?"
)

Found = TypeVar("Found")
Ask = Callable[[str], str]


@dataclass(frozen=True)
class StationTakes:
    """Records takes with a running station and locates them.

    Attributes:
        request: sends a request to the station, as `HttpLink.request`.
        spool: the station's spool, if accessible from this machine.
        has_store: whether takes may be read from the store that the station uploads to.
        wait: sleeps.
    """

    request: Callable[..., Reply]
    spool: Path
    has_store: bool
    wait: Callable[[float], None] = time.sleep

    def record(
        self, name: str, words: str, seconds: float, check: Callable[[str], Found]
    ) -> tuple[str, Found]:
        """Record a valid take; interrupted and invalid ones are discarded.

        Args:
            name: id of the take.
            words: description for the operator, also the take's instruction.
            seconds: duration.
            check: raises an error for an invalid take. If takes are only in the store, it runs
                after the take is saved.

        Returns:
            The take's folder in the spool, or its id in the store; and the result of the check.

        Raises:
            ConflictError: the recorder is busy with another take; save or discard that.
            UnavailableError: the station does not respond.
            NotFoundError: neither spool nor store has the take.
        """
        self._act("arm", {"task": TASK, "instruction": words})
        self._act("record", {"recording_id": name})
        folder, found, is_good = self.spool / name, None, False
        try:
            num_ticks = round(seconds / TICK_S)
            for _ in progress(range(num_ticks), words, num_ticks):
                self.wait(TICK_S)
            self._act("stop", {"recording_id": name})
            if folder.is_dir():
                found = check(str(folder.resolve()))
            is_good = True
        finally:
            if not is_good:
                self._act("discard", {"recording_id": name})
        # Other devices may be absent; the presence of the glove shows in its readings.
        self._act("save", {"recording_id": name, "accept_incomplete": True})
        if found is not None:
            return str(folder.resolve()), found
        stored_as = self._await_upload(name)
        return stored_as, check(stored_as)

    def _act(self, action: str, body: dict[str, object]) -> None:
        self.request("POST", f"/v1/recorder/{action}", body=json.dumps(body).encode())

    def _await_upload(self, name: str) -> str:
        """Wait for the upload and return the take's id in the store."""
        if not self.has_store:
            raise NotFoundError(
                f"take {name!r}: not in {self.spool.resolve()}; name the station's spool with "
                "--spool, or on another machine its store with --store URL"
            )
        for _ in progress(range(round(UPLOAD_S)), "waiting for the upload", round(UPLOAD_S)):
            uploads = json.loads(self.request("GET", "/v1/uploads").body)
            for take in uploads:
                if take["recording_id"] == name and take["uploaded"]:
                    return str(take.get("stored_as") or name)
            self.wait(1.0)
        raise NotFoundError(
            f"take {name!r}: the station did not upload it within {UPLOAD_S:g} s; look at its "
            "uploads, then calibrate with --rest and --presses"
        )


def station_takes(options: argparse.Namespace) -> StationTakes:
    """Create the helper for the station of the options."""
    link = HttpLink(options.url, api_key=options.key)
    return StationTakes(link.request, options.spool, has_store=options.store is not None)


def walk(
    options: argparse.Namespace, takes: StationTakes, *, ask: Ask = input
) -> tuple[str, Sequence[PressRow]]:
    """Lead an operator through rest and presses; returns the rest take and valid presses.

    An invalid take is explained and repeated. The list of presses is stored in the folder, so that
    the calibration can be repeated from the same takes.

    Raises:
        InvalidInputError: no operator input.
    """
    guide = _Guide(options, takes, ask)
    rest, tare = guide.rest()
    rows = guide.presses(tare)
    again = f"dextouch station calibrate glove --side {options.side} --rest {rest}"
    if rows:
        path = options.to / f"presses_{options.side}.csv"
        write_presses(path, rows)
        again += f" --presses {path}"
    print(f"The same takes again: {again} --to {options.to}")
    return rest, rows


class _Guide:
    """Dialogue with the operator and the station."""

    def __init__(self, options: argparse.Namespace, takes: StationTakes, ask: Ask) -> None:
        self._options, self._takes, self._ask = options, takes, ask
        self._started = f"calibration-glove-{options.side}-{datetime.now(UTC):%Y%m%d-%H%M%S}"
        self._num_takes = 0

    def rest(self) -> tuple[str, TaxelTare]:
        """Record a rest take with a valid tare."""
        side = self._options.side
        while True:
            self._answer(
                f"Lay the {side} glove down, untouched, and let it rest for a minute. "
                f"Enter records {REST_S:g} s: "
            )
            try:
                return self._record(
                    f"{side} glove at rest, untouched",
                    REST_S,
                    lambda take: measure_tare(read_take(take, self._options).values, side=side),
                )
            except InvalidInputError as error:
                print(f"Once more: {error.message}")

    def presses(self, tare: TaxelTare) -> list[PressRow]:
        """Record presses until the operator is done."""
        print(f"Now two to four known pressures, the highest as high as work needs: {PRESS_HELP}.")
        rows: list[PressRow] = []
        known: list[TaxelPress] = []
        while words := self._answer(NEXT).strip():
            if words == "drop":
                rows, known = rows[:-1], known[:-1]
                print(f"{len(rows)} presses are left")
                continue
            try:
                wanted = parse_press(words, self._options.pressure_sigma)
            except (InvalidInputError, UnknownNameError) as error:
                print(error.message)
                continue
            target = f"{wanted.pressure_kpa:.4g} kPa on {wanted.pads}"
            self._answer(f"Put {target}. Enter records {PRESS_S:g} s, once it holds still: ")
            try:
                take, press = self._record(
                    f"{target}, held still", PRESS_S, partial(self._press, tare, wanted)
                )
            except InvalidInputError as error:
                print(f"Not used: {error.message}")
                continue
            rows.append(wanted.model_copy(update={"take": take}))
            known.append(press)
            print(self._known_so_far(tare, known))
        return rows

    def _known_so_far(self, tare: TaxelTare, presses: list[TaxelPress]) -> str:
        try:
            found = calibrate_glove(
                tare, presses, full_scale_counts=self._options.full_scale
            ).num_by_state()
        except InvalidInputError as error:
            return f"{len(presses)} presses, not enough yet: {error.message}"
        others = ", ".join(f"{n} {state}" for state, n in found.items() if state != "ok")
        return (
            f"{len(presses)} presses: {found['ok']} of 320 taxels known"
            f"{f' ({others})' if others else ''}; more pressures show bends"
        )

    def _press(self, tare: TaxelTare, wanted: PressRow, take: str) -> TaxelPress:
        """The press of a take, if it determines a gain on its own."""
        press = press_of(wanted.model_copy(update={"take": take}), self._options)
        fit_gain(tare, [press], full_scale_counts=self._options.full_scale)
        return press

    def _record(
        self, words: str, seconds: float, check: Callable[[str], Found]
    ) -> tuple[str, Found]:
        self._num_takes += 1
        return self._takes.record(f"{self._started}-{self._num_takes}", words, seconds, check)

    def _answer(self, question: str) -> str:
        try:
            return self._ask(question)
        except EOFError as error:
            raise InvalidInputError(
                "calibrate glove --url: nobody answers; run it at a terminal, or name takes with "
                "--rest and --presses"
            ) from error


def parse_press(words: str, relative_sigma: float) -> PressRow:
    """Parse a pressure typed by the operator (`PRESS_HELP`), before its take.

    Raises:
        InvalidInputError: no pressure above 0.
        UnknownNameError: no such pad.
    """
    matched = _PRESS.fullmatch(words.strip().lower())
    groups = matched.groupdict() if matched else {}
    given = {name: text for name, text in groups.items() if text}
    try:
        row = PressRow.model_validate({"take": ""} | given)
    except ValidationError as error:
        raise InvalidInputError(
            f"pressure: got {words!r}, expected {PRESS_HELP}, above 0"
        ) from error
    pad_taxels(row.pads)
    return row.known_to(relative_sigma)
