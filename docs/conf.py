"""Sphinx configuration of the documentation site, built by `make docs`."""

import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS / "extensions"), str(DOCS.parent / "shared")]

from dextouch import __version__  # noqa: E402 - found by the path above

project = "DexTouch"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "front_door"]
exclude_patterns = ["extensions"]
html_theme = "furo"
html_title = f"DexTouch {release}"
html_show_copyright = False
html_show_sphinx = False
html_copy_source = False

# Headings are anchors under the names that GitHub gives them.
myst_heading_anchors = 4
# Blocks of JSON and shell hold ellipses, which are no syntax of these languages.
suppress_warnings = ["misc.highlighting_failure"]

# Single back quotes of docstrings are code.
default_role = "code"
napoleon_use_ivar = True
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
# Packages of the extras export, s3 and rerun, which the site does without.
autodoc_mock_imports = [
    "foxglove_schemas_protobuf", "google", "lz4", "mcap", "mcap_ros2", "obstore", "pyarrow",
    "rerun",
]  # fmt: skip
