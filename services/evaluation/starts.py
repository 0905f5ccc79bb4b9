"""Digests of first observations, which keep training and evaluation starts disjoint."""

import hashlib
from collections.abc import Iterable

import numpy as np

from dextouch.errors import ConflictError, InvalidInputError


def start_digest(head_image: np.ndarray, tactile_kpa: np.ndarray) -> str:
    """SHA-256 of a first observation: head camera image [h, w, 3] and taxels [2, 320] in kPa.

    The same task and seed give the same first observation, so equal digests mean the same start.
    """
    image = np.ascontiguousarray(head_image, dtype=np.uint8)
    tactile = np.ascontiguousarray(tactile_kpa, dtype="<f4")
    if image.ndim != 3 or tactile.shape != (2, 320):
        raise InvalidInputError(
            f"start: got image {image.shape} and tactile {tactile.shape}, "
            "expected one image [h, w, 3] and [2, 320]"
        )
    digest = hashlib.sha256(repr((image.shape, tactile.shape)).encode())
    digest.update(image.tobytes())
    digest.update(tactile.tobytes())
    return digest.hexdigest()


def refuse_training_starts(digests: Iterable[str], *, trained_on: Iterable[str], what: str) -> None:
    """Raise if a start of the evaluation was trained on.

    Args:
        digests: digests of the evaluation's starts.
        trained_on: digests of the first observations of the training episodes.
        what: the trained network, for the error message.

    Raises:
        ConflictError: a start of the evaluation was trained on.
    """
    shared = sorted(set(digests) & set(trained_on))
    if shared:
        raise ConflictError(
            f"evaluation: {len(shared)} starts were trained on by {what}, first {shared[0][:12]}…; "
            "choose others, outside its training data",
            starts=shared,
        )
