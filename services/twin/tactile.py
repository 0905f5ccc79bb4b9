"""Tactile sensing of the simulated skin: taxel pressures [2, 320] and pad forces from contacts.

MuJoCo's tactile sensor gives the penetration depth of each taxel, hence the *pattern*; the contact
solver gives the force on each pad, hence the *magnitude*. Depths are converted to pressures of an
elastic layer that integrate to the pad's force; if a pad is pressed without any taxel penetrating,
the force goes to the taxel nearest to each contact.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float32, Float64

from dextouch.tactile.layout import FINGERS, NUM_TAXELS, SIDES, taxel_areas_m2
from services.twin.scene import Scene

# A contact farther than this from every taxel is on the back of the hand and not sensed.
FELT_WITHIN_M = 0.008
# Elastic layer, fitted to an analytic one of 20 kPa/mm (tests/accuracy/test_twin_tactile.py).
SKIN_STIFFNESS_PA_M = 1.4e7
# Sensor depths include the skin's offset and the compliance of the contact. At most this much is
# subtracted: a flat face needs some depth to cover the sensor's errors at its edges.
MAX_RELIEF_M = 0.002
_MIN_FORCE_N = 1e-6
_MIN_DEPTH_M = 1e-9
_PASCAL_PER_KPA = 1000.0


@dataclass(frozen=True)
class _Pad:
    side_index: int
    pad_index: int
    taxels: slice
    depths: slice
    skin_geom: int
    vertices_m: np.ndarray


class TactileReader:
    """Tactile sensors of both hands of a scene."""

    def __init__(self, scene: Scene) -> None:
        self._model = scene.model
        self._areas_m2 = taxel_areas_m2()
        self._pads: list[_Pad] = []
        self._pad_of_geom = np.full(scene.model.ngeom, -1, dtype=np.int64)
        for side_index, side in enumerate(SIDES):
            first_taxel = 0
            for pad_index, pad in enumerate((*FINGERS, "palm")):
                added = self._add_pad(f"{side}_{pad}", (side_index, pad_index), first_taxel)
                felt = f"{side}_palm" if pad == "palm" else f"{side}_{pad}_link3"
                self._pad_of_geom[scene.model.geom(felt).id] = len(self._pads) - 1
                first_taxel = added.taxels.stop

    def _add_pad(self, name: str, index: tuple[int, int], first_taxel: int) -> _Pad:
        model = self._model
        skin = model.geom(f"{name}_skin").id
        mesh = int(model.geom_dataid[skin])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        address = int(model.sensor_adr[model.sensor(name).id])
        pad = _Pad(
            *index,
            slice(first_taxel, first_taxel + count),
            slice(address, address + count),
            int(skin),
            np.array(model.mesh_vert[first : first + count], dtype=np.float64),
        )
        self._pads.append(pad)
        return pad

    @staticmethod
    def _skin_world_m(data: mujoco.MjData, pad: _Pad) -> Float64[np.ndarray, "taxels 3"]:
        R_world_skin = data.geom_xmat[pad.skin_geom].reshape(3, 3)
        return pad.vertices_m @ R_world_skin.T + data.geom_xpos[pad.skin_geom]

    def _pad_contacts(self, data: mujoco.MjData) -> dict[int, list[int]]:
        """Contact indices by pressed pad."""
        pads = self._pad_of_geom[data.contact.geom[: data.ncon]].max(axis=1)
        contacts: dict[int, list[int]] = {}
        for contact_index in np.flatnonzero(pads >= 0):
            contacts.setdefault(int(pads[contact_index]), []).append(int(contact_index))
        return contacts

    def read(
        self, data: mujoco.MjData
    ) -> tuple[Float32[np.ndarray, "2 320"], Float64[np.ndarray, "2 6"]]:
        """Pressures (kPa) and pad forces (N: five tips, palm), left then right.

        `data` must be consistent (after `mj_forward` with sensors enabled).
        """
        forces_n = np.zeros((len(SIDES), NUM_TAXELS))
        pad_forces_n = np.zeros((len(SIDES), len(FINGERS) + 1))
        if data.ncon:
            for index, contacts in self._pad_contacts(data).items():
                pad = self._pads[index]
                spread = self._spread(data, pad, contacts)
                forces_n[pad.side_index, pad.taxels] = spread
                pad_forces_n[pad.side_index, pad.pad_index] = spread.sum()
        pressures = forces_n / self._areas_m2 / _PASCAL_PER_KPA
        return pressures.astype(np.float32), pad_forces_n

    def _spread(
        self, data: mujoco.MjData, pad: _Pad, contacts: list[int]
    ) -> Float64[np.ndarray, " taxels"]:
        """Distribute the normal force of a pad's contacts to its taxels."""
        offsets = self._skin_world_m(data, pad)[None] - data.contact.pos[contacts][:, None]
        distances = np.linalg.norm(offsets, axis=2)
        nearest = distances.argmin(axis=1)
        wrench = np.zeros(6)
        on_nearest_n = np.zeros(len(pad.vertices_m))
        for contact_index, taxel, row in zip(contacts, nearest, distances, strict=True):
            if row[taxel] <= FELT_WITHIN_M:
                mujoco.mj_contactForce(self._model, data, contact_index, wrench)
                on_nearest_n[taxel] += wrench[0]
        force_n = float(on_nearest_n.sum())
        if force_n < _MIN_FORCE_N:
            return np.zeros_like(on_nearest_n)
        depths = np.maximum(data.sensordata[pad.depths], 0.0)
        if depths.max() < _MIN_DEPTH_M:
            return on_nearest_n
        return elastic_layer(
            depths, force_n, SKIN_STIFFNESS_PA_M * self._areas_m2[pad.taxels.start]
        )


def elastic_layer(
    depths_m: Float64[np.ndarray, " taxels"],
    force_n: float,
    stiffness_n_m: float,
) -> Float64[np.ndarray, " taxels"]:
    """Forces of an elastic layer at depths that are known up to a common offset c.

    Solves Σ k max(0, depth - c) = F over the touched taxels, c at most MAX_RELIEF_M, and scales
    the result so that it sums to F.

    Args:
        depths_m: 0 or more, at least one of them positive.
        force_n: sum of the forces.
        stiffness_n_m: stiffness of one taxel.
    """
    touched = depths_m > 0.0
    deepest_first = np.sort(depths_m[touched])[::-1]
    num_pressed = np.arange(1, deepest_first.size + 1)
    reliefs_m = (np.cumsum(deepest_first) - force_n / stiffness_n_m) / num_pressed
    relief_m = min(reliefs_m[np.flatnonzero(reliefs_m < deepest_first)[-1]], MAX_RELIEF_M)
    springs = np.where(touched, np.maximum(depths_m - relief_m, 0.0), 0.0)
    return springs * (force_n / springs.sum())
