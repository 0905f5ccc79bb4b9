"""Table of planted bugs: one-line changes of the product that some test has to notice."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLANTED = Path(__file__).parent / "planted"


@dataclass(frozen=True)
class PlantedBug:
    """One change of one file.

    Attributes:
        area: name of the table's file.
        file: that is changed, relative to the repository.
        old: text that occurs exactly once in the file.
        new: text that takes its place.
        what: the wrong behaviour, in a few words.
        tests: files that are run, quickest first; one of them must fail.
    """

    area: str
    file: str
    old: str
    new: str
    what: str
    tests: tuple[str, ...]

    def planted(self, source: str) -> str:
        """The file's text with the bug in it.

        Raises:
            ValueError: the old text does not occur exactly once.
        """
        count = source.count(self.old)
        if count != 1:
            raise ValueError(
                f"{self.area}, {self.what}: {self.file} holds {self.old!r} {count} times"
            )
        return source.replace(self.old, self.new)


def planted_bugs(areas: tuple[str, ...] = ()) -> list[PlantedBug]:
    """The bugs of the named areas, of all where none is named.

    Raises:
        ValueError: an area that does not exist.
    """
    files = {path.stem: path for path in sorted(PLANTED.glob("*.toml"))}
    unknown = sorted(set(areas) - set(files))
    if unknown:
        raise ValueError(f"areas {unknown}: expected some of {sorted(files)}")
    return [
        PlantedBug(
            area=area,
            file=bug["file"],
            old=bug["old"],
            new=bug["new"],
            what=bug["what"],
            tests=tuple(bug["tests"]),
        )
        for area in (areas or files)
        for bug in tomllib.loads(files[area].read_text(encoding="utf-8"))["bug"]
    ]
