"""Tactile sensing of a hand: taxel layout, contact threshold, pad forces and heat maps."""

from dextouch.tactile.contact import CONTACT_THRESHOLD_KPA, in_contact
from dextouch.tactile.heatmap import colour, hand_canvas
from dextouch.tactile.pad_forces import PADS, pad_forces_n

__all__ = [
    "CONTACT_THRESHOLD_KPA",
    "PADS",
    "colour",
    "hand_canvas",
    "in_contact",
    "layout",
    "pad_forces_n",
]
