"""Tactile sensing of a hand: taxel layout, contact threshold, pad forces and heat maps."""

from dextouch.tactile.layout import (
    CONTACT_THRESHOLD_KPA,
    PADS,
    colour,
    hand_canvas,
    in_contact,
    pad_forces_n,
)

__all__ = [
    "CONTACT_THRESHOLD_KPA",
    "PADS",
    "colour",
    "hand_canvas",
    "in_contact",
    "layout",
    "pad_forces_n",
]
