"""Tactile sensing of a hand: taxel layout, contact threshold, pad forces and heat maps."""

from dextouch.tactile.contact import CONTACT_THRESHOLD_KPA, PADS, in_contact, pad_forces_n
from dextouch.tactile.heatmap import colour, hand_canvas

__all__ = [
    "CONTACT_THRESHOLD_KPA",
    "PADS",
    "colour",
    "hand_canvas",
    "in_contact",
    "layout",
    "pad_forces_n",
]
