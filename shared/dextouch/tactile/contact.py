"""Contact threshold of taxels."""

import numpy as np
from jaxtyping import Bool

CONTACT_THRESHOLD_KPA = 2.0


def in_contact(tactile_kpa: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Mask of taxels in contact: pressure of at least 2 kPa. NaN is not contact."""
    return np.asarray(tactile_kpa) >= CONTACT_THRESHOLD_KPA
