"""Sphinx directive `front-door` that documents the public names of a package of `dextouch`.

A package is documented by the names in its `__all__`: functions, classes and constants under the
package's name, public modules in a section of their own.
"""

import importlib
import pkgutil

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.ext.autodoc.mock import mock
from sphinx.util.docutils import SphinxDirective

import dextouch


class FrontDoor(SphinxDirective):
    """`.. front-door:: dextouch.clocks`."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes of `automodule` for the package and for each of its public modules."""
        name = self.arguments[0]
        package = importlib.import_module(name)
        lines = [f".. automodule:: {name}", ""]
        for module in pkgutil.iter_modules(getattr(package, "__path__", ())):
            if module.name in package.__all__:
                title = f"{name}.{module.name}"
                lines += [title, "-" * len(title), "", f".. automodule:: {title}", ""]
        section = nodes.section()
        section.document = self.state.document
        text = StringList(lines, source=f"modules of {name}")
        self.state.nested_parse(text, self.content_offset, section, match_titles=True)
        return section.children


def import_all(app: Sphinx) -> None:
    """Import every module before autodoc does.

    Autodoc imports with `typing.TYPE_CHECKING` set, where pydantic and fastapi refuse to work.
    """
    with mock(app.config.autodoc_mock_imports):
        for module in pkgutil.walk_packages(dextouch.__path__, "dextouch."):
            importlib.import_module(module.name)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("front-door", FrontDoor)
    app.connect("builder-inited", import_all)
    return {"parallel_read_safe": True}
