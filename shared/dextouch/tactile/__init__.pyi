from . import layout as layout
from .layout import CONTACT_THRESHOLD_KPA as CONTACT_THRESHOLD_KPA
from .layout import PADS as PADS
from .layout import colour as colour
from .layout import hand_canvas as hand_canvas
from .layout import in_contact as in_contact
from .layout import pad_forces_n as pad_forces_n
