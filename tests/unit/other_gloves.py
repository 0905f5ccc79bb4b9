"""Layout of a small glove whose cells are wired at random, for tests."""

import numpy as np

from dextouch.tactile import RawCells, TactilePad
from dextouch.tactile.layout import TactileLayout

TIP_AREA_M2, PALM_AREA_M2 = 12e-6, 80e-6
ORIGINS = ((7, 20), (2, 13), (0, 8), (2, 3), (5, 0))


def small_layout(*, unit="N", full_scale=4.0, range_kpa=50.0, seed=3):
    """5 × (3 × 5) + 7 × 9 = 138 taxels in 150 raw cells, in another random order for each side."""
    rng = np.random.default_rng(seed)
    order = {side: tuple(rng.permutation(150)[:138].tolist()) for side in ("left", "right")}
    parts = ("thumb", "index", "middle", "ring", "little")
    tips = [
        TactilePad(
            part=part,
            rows=3,
            columns=5,
            pitch_m=(0.005, 0.003),
            taxel_area_m2=TIP_AREA_M2,
            origin=origin,
        )
        for part, origin in zip(parts, ORIGINS, strict=True)
    ]
    palm = TactilePad(
        part="palm",
        rows=7,
        columns=9,
        pitch_m=(0.012, 0.009),
        taxel_area_m2=PALM_AREA_M2,
        origin=(11, 7),
    )
    return TactileLayout(
        name="small",
        pads=(*tips, palm),
        num_raw_cells=150,
        raw_cells=RawCells(**order),
        canvas=(18, 25),
        unit=unit,
        full_scale=full_scale,
        range_kpa=range_kpa,
        nominal_rate_hz=50,
    )


def largest_layout():
    """A palm of 64 × 64 = 4096 taxels, as many as a layout may have, wired at random."""
    rng = np.random.default_rng(4)
    order = {side: tuple(rng.permutation(4096).tolist()) for side in ("left", "right")}
    pad = TactilePad(
        part="palm",
        rows=64,
        columns=64,
        pitch_m=(0.001, 0.001),
        taxel_area_m2=1e-6,
        origin=(0, 0),
    )
    return TactileLayout(
        name="largest",
        pads=(pad,),
        num_raw_cells=4096,
        raw_cells=RawCells(**order),
        canvas=(64, 64),
        unit="kPa",
        full_scale=100.0,
        range_kpa=100.0,
        nominal_rate_hz=50,
    )
