"""Decoder of our tactile glove, under the name that code outside this repository imports.

The driver itself is `services.acquisition.devices.tactile_glove`.
"""

from services.acquisition.devices.tactile_glove import TactileGloveDecoder

__all__ = ["TactileGloveDecoder"]
