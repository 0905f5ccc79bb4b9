"""Relabels: a new item of the same arrays with other attributes, at hardly any cost of disk."""

import json
import shlex
from collections.abc import Mapping

from pydantic import ValidationError

from dextouch.episodes.care import DeletionRecords
from dextouch.episodes.editing.edits import DEFAULTS, Edit, EditOptions, new_outcome
from dextouch.episodes.files import GroupFiles
from dextouch.episodes.format import (
    ATTRIBUTES_KEY,
    COMMIT_FILE,
    METADATA_FILE,
    Attributes,
    Kind,
    attributes_id,
    canonical_json,
    sha256_hex,
)
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import CorruptDataError, InvalidInputError
from dextouch.free_text import check_line
from dextouch.schemas import (
    EditedItem,
    EditedOutcome,
    EpisodeAttributes,
    first_problems,
    json_ready,
)

# Attributes that can be changed, beside the outcome.
LABELS = ("task", "instruction", "operator")


def relabel_item(
    store: EpisodeStore,
    item_id: str,
    changes: Mapping[str, str],
    *,
    kind: Kind = "episode",
    outcome: EditedOutcome | None = None,
    options: EditOptions = DEFAULTS,
) -> EditedItem:
    """Write an item with other attributes, and the same arrays, as a new one, which supersedes it.

    The files of the arrays are shared with the source where the file system can.

    Args:
        store: where the item is.
        item_id: of the source.
        changes: new values of some of `task`, `instruction` and `operator`.
        kind: of the item.
        outcome: new outcome; another task must be given one, if the item was judged.
        options: of all edits.

    Raises:
        InvalidInputError: nothing changes, a value is invalid, or the outcome is lacking.
        NotFoundError, CorruptDataError, ConflictError, UnavailableError: as `trim_episode`.
    """
    with store.held(item_id, kind=kind):
        reader = store.open_item(kind, item_id)
        about = reader.attributes
        changed = {key: text for key, text in changes.items() if getattr(about, key) != text}
        operator = changed.get("operator")
        if operator is not None and DeletionRecords(store.root).has_operator(operator):
            raise InvalidInputError(
                f"relabel {kind} {item_id!r}: the operator was permanently deleted from the store, "
                "expected another, or `dextouch store deletions --readmit` first"
            )
        is_other_task = "task" in changed
        lacking = f"it becomes one of {changed.get('task')!r}" if is_other_task else ""
        fields: dict[str, object] = {**changed, **new_outcome(about, outcome, lacking=lacking)}
        if not {key for key, value in fields.items() if getattr(about, key) != value}:
            raise InvalidInputError(
                f"{kind} {item_id!r}: nothing changes; expected another --task, --instruction, "
                "--operator or --outcome than it has"
            )
        # Not the pseudonym: the lineage of later items must not name an operator.
        shown = {key: "…" if key == "operator" else text for key, text in changed.items()}
        if outcome is not None:
            shown["outcome"] = outcome
        text = shlex.join(["relabel", *(part for k, v in shown.items() for part in (f"--{k}", v))])
        edit = Edit(store, reader, "relabelled", text, options, fields)
        if is_other_task and isinstance(about, EpisodeAttributes) and about.event_times_s:
            edit.messages.append(f"events of {about.task!r} are left out")
            fields = {**fields, "event_times_s": {}}
        fields = fields | {f"{kind}_id": edit.new_id, "lineage": edit.lineage}
        attributes = about.model_copy(update=fields)
        try:
            for value in changed.values():
                check_line(value)
            type(about).model_validate(dict(attributes))
        except ValueError as error:
            why = first_problems(error) if isinstance(error, ValidationError) else str(error)
            raise InvalidInputError(f"relabel {kind} {item_id!r}: {why}") from error
        metadata, commit = with_attributes(store.files(item_id, kind=kind), attributes)

        def write(writer: EpisodeWriter) -> None:
            files = store.files(item_id, kind=kind)
            writer.take_files(files, metadata=metadata, commit=commit, link=True)

        counts = {name: reader.num_samples(name) for name in reader.streams}
        # Its streams are files that exist already.
        shell = attributes.model_copy(update={"streams": ()})
        return edit.run(shell, counts, write, edit.remarks(clicks_hold=not is_other_task))


def with_attributes(files: GroupFiles, attributes: Attributes) -> tuple[bytes, bytes]:
    """`zarr.json` and `commit.json` of a group whose arrays stay, with other attributes."""
    metadata, commit = files.get(METADATA_FILE), files.get(COMMIT_FILE)
    if metadata is None or commit is None:
        raise CorruptDataError(f"{files.item_id}: {METADATA_FILE} or {COMMIT_FILE} is missing")
    group, record = json.loads(metadata), json.loads(commit)["record"]
    group["attributes"][ATTRIBUTES_KEY] = json_ready(attributes)
    changed = canonical_json(group)
    record |= {"id": attributes_id(attributes), "attributes_sha256": sha256_hex(changed)}
    digest = sha256_hex(canonical_json(record))
    return changed, canonical_json({"record": record, "sha256": digest})
