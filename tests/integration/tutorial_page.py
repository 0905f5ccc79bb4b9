"""A page of docs/tutorials taken apart: the files it has a reader write, its commands and code."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from services.cli import main

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class TutorialPage:
    """Files by their paths, in the page's order; lines of `sh` blocks; other `python` blocks."""

    files: tuple[tuple[str, str], ...]
    commands: tuple[str, ...]
    cells: tuple[str, ...]
    outputs: tuple[str, ...]

    @classmethod
    def read(cls, name):
        text = (ROOT / f"docs/tutorials/{name}.md").read_text(encoding="utf-8")
        file = re.compile(r"\*\*`([\w./-]+)`\*\*\n\n```\w+\n(.*?)```", re.DOTALL)
        rest = file.sub("", text)
        shell = "".join(_blocks(rest, "sh")).replace("\\\n", " ")
        return cls(
            files=tuple(file.findall(text)),
            commands=tuple(shell.splitlines()),
            cells=_blocks(rest, "python"),
            outputs=_blocks(rest, "text"),
        )

    def write_files(self, folder):
        for path, text in self.files:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text, encoding="utf-8")

    def command(self, start):
        """The words of the one command that begins so."""
        (line,) = (line for line in self.commands if line.startswith(start))
        return shlex.split(line)


def readme_commands(quick):
    """The commands of README's "Try it" in order, with others in place of those in `quick`."""
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("## Try it")[1]
    lines = "".join(_blocks(section.split("\n## ")[0], "")).splitlines()
    typed = [shlex.split(line, comments=True) for line in lines]
    wanted = [
        quick.get(tuple(words), [Path(words[0]).name, *words[1:]]) for words in typed if words
    ]
    return [words for words in wanted if words]


def run_command(words, addresses=None):
    """Run `dextouch …` of a page here, its services at other addresses than the page says."""
    assert words[0] == "dextouch"
    for written, url in (addresses or {}).items():
        words = [word.replace(written, url) for word in words]
    assert main.main(words[1:]) == 0


def _blocks(text, language):
    return tuple(re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL))
