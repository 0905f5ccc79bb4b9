"""Under tests, and only there, every annotated array shape is checked at run time."""

import os

from hypothesis import settings
from jaxtyping import install_import_hook

os.environ.setdefault("OMP_NUM_THREADS", "1")
# On the emulated processor of `make vm` these checks would take minutes.
if "DEXTOUCH_VM_GUEST" not in os.environ:
    install_import_hook(["dextouch", "services"], "beartype.beartype")

# The same examples in every run: a change is red because of the change, not because of the day.
# No deadline: machines that are busy with other things are slow, not wrong.
settings.register_profile("steady", derandomize=True, deadline=None)
settings.load_profile("steady")
