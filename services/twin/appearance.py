"""Appearance of a scene: colours of geoms, light and table, fixed or varied from take to take."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

TO_LIGHT: Final = np.array([0.30, -0.40, 0.85])
AMBIENT: Final = 0.35
BACKGROUND: Final = np.array([0.16, 0.17, 0.20])
CHECKER_DEPTH: Final = 0.14
# Two of three takes keep the colours of the task about; in the others, objects have any colour.
_ANY_COLOUR: Final = 0.33


@dataclass(frozen=True)
class Appearance:
    """What a scene looks like besides its geometry.

    `colours` are RGB 0 … 1 of every geom, `to_light` the direction to the light, `ambient` the
    share of light from everywhere, `checker_depth` how much darker every second field of the table
    is.
    """

    colours: Float64[np.ndarray, "geoms 3"]
    to_light: Float64[np.ndarray, "3"]
    background: Float64[np.ndarray, "3"]
    ambient: float = AMBIENT
    checker_depth: float = CHECKER_DEPTH

    @classmethod
    def of(cls, colours: Float64[np.ndarray, "geoms 3"]) -> "Appearance":
        """The fixed appearance of geoms with their own colours."""
        return cls(colours, TO_LIGHT / np.linalg.norm(TO_LIGHT), BACKGROUND)

    def varied(
        self, generator: np.random.Generator, geom_object: np.ndarray, table: int
    ) -> "Appearance":
        """Other colours of objects and table, another light.

        Args:
            generator: source of the variation.
            geom_object: object of each geom, −1 for none.
            table: geom of the table.
        """
        colours = self.colours.copy()
        for index in range(int(geom_object.max()) + 1):
            own = geom_object == index
            tint = generator.normal(scale=0.10, size=3)
            if generator.random() < _ANY_COLOUR:
                tint = generator.uniform(0.1, 0.95, size=3) - colours[own].mean(axis=0)
            colours[own] += tint
        hands = geom_object < 0
        hands[table] = False
        colours[hands] *= generator.uniform(0.8, 1.2)
        colours[table] += generator.normal(scale=0.08) + generator.normal(scale=0.04, size=3)
        light = TO_LIGHT + generator.normal(scale=[0.25, 0.25, 0.1])
        return Appearance(
            colours.clip(0.02, 1.0),
            light / np.linalg.norm(light),
            (BACKGROUND + generator.normal(scale=0.05)).clip(0, 1),
            ambient=float(generator.uniform(0.25, 0.5)),
            checker_depth=float(generator.uniform(0.0, 0.25)),
        )
