"""Documents of this release as HTML, the help of the dashboard on a machine without a network."""

import posixpath
import re
import sysconfig
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Final
from urllib.parse import urlsplit

from markdown_it import MarkdownIt
from markdown_it.token import Token
from markupsafe import Markup
from pydantic import Field, ValidationError

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems

HELP = "/help/"


def find_documents() -> Path:
    """The folder `docs` of this repository, or of the installed package."""
    here = Path(__file__).parents[2] / "docs"
    return here if here.is_dir() else Path(sysconfig.get_path("data")) / "share/dextouch/docs"


@dataclass(frozen=True)
class Document:
    """A document as HTML, and the titles of all others by name."""

    name: str
    html: Markup
    titles: Mapping[str, str]


class Documents:
    """Markdown files of a folder; HTML in them is shown as text."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._markdown = MarkdownIt("commonmark", {"html": False}).enable("table")

    @cached_property
    def _paths(self) -> dict[str, Path]:
        found = sorted(self._folder.rglob("*.md"))
        return {path.relative_to(self._folder).with_suffix("").as_posix(): path for path in found}

    @cached_property
    def titles(self) -> dict[str, str]:
        """First headings of the documents at the top of the folder, by name."""
        return {name: _title(path) for name, path in self._paths.items() if "/" not in name}

    def read(self, name: str) -> Document:
        """One document by its name, which is its path without `.md`.

        Raises:
            NotFoundError: no such document, or none is installed.
        """
        if name not in self._paths:
            known = ", ".join(self.titles) or f"none is installed in {self._folder}"
            raise NotFoundError(f"document {name!r}: not one of this release ({known})")
        tokens = self._markdown.parse(self._paths[name].read_text(encoding="utf-8"))
        for token, following in zip(tokens, [*tokens[1:], None], strict=True):
            if token.type == "heading_open" and following is not None:
                token.attrSet("id", _anchor(following.content))
            for part in token.children or ():
                self._link(part, posixpath.dirname(name))
        html = self._markdown.renderer.render(tokens, self._markdown.options, {})
        return Document(name, Markup(html), self.titles)  # noqa: S704 - HTML is off in the parser

    def _link(self, part: Token, folder: str) -> None:
        """Lead links between documents to their pages; those to other files of a checkout go."""
        if part.type == "image":
            # Pictures are not served; their description stays.
            part.type, part.tag = "text", ""
            return
        if part.type != "link_open":
            return
        target = urlsplit(str(part.attrGet("href")))
        name = posixpath.normpath(posixpath.join(folder, target.path)).removesuffix(".md")
        if target.scheme:
            part.attrSet("rel", "noreferrer")
        elif target.path and name not in self._paths:
            del part.attrs["href"]
        elif target.path:
            part.attrSet("href", f"{HELP}{name}" + (f"#{target.fragment}" * bool(target.fragment)))


def _title(path: Path) -> str:
    found = re.search(r"^# (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return found[1] if found else path.stem


def _anchor(heading: str) -> str:
    """Anchor of a heading, by the rules of common hosts of Markdown."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


# Tasks that the recorder offers, with their instructions, goals and reset times, from TOML.

# The twin's tasks.
DEFAULT_TASKS: Final = Path(__file__).with_name("tasks.toml")


class TaskChoice(FrozenModel):
    """A task of the list; `goal` and `reset_s` are used in place of those of the settings."""

    name: FreeText = Field(min_length=1, max_length=128)
    instructions: tuple[Annotated[FreeText, Field(min_length=1, max_length=2000)], ...] = Field(
        min_length=1
    )
    goal: int | None = Field(default=None, ge=0, le=1_000_000)
    reset_s: float | None = Field(default=None, ge=0, le=3600)


class _TaskFile(FrozenModel):
    tasks: tuple[TaskChoice, ...] = Field(min_length=1, max_length=1000)


def load_tasks(path: Path | None) -> tuple[TaskChoice, ...]:
    """Tasks of a file; by default those of the twin.

    Raises:
        InvalidInputError: the file cannot be read, is not TOML or has other fields.
    """
    path = path or DEFAULT_TASKS
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return _TaskFile.model_validate(tables).tasks
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"task file {path}: cannot be read: {error}") from error
    except ValidationError as error:
        raise InvalidInputError(
            f"task file {path}: {first_problems(error)}; expected tables [[tasks]] with name, "
            "instructions and optionally goal and reset_s"
        ) from error
