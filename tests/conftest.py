"""Under tests, and only there, every annotated array shape is checked at run time."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from jaxtyping import install_import_hook

install_import_hook(["dextouch", "services"], "beartype.beartype")
