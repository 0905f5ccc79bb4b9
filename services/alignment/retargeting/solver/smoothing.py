"""Smoothing of tracked points by the tracker's own noise, live and, without lag, of recordings.

A point follows each sample by a part that depends on how far off the sample is: hardly if that may
be noise, nearly all of the way if it is much more. With e the distance and v the mean square of
the noise's length, the part is e²/(e² + v). A point that moves steadily is therefore behind by at
most √v/2, whatever its speed and the tracker's rate; without noise it is never behind.
"""

from typing import no_type_check

import numpy as np

from services.alignment.retargeting.solver import compiled, compiled_once

# Bones whose length a live hand's noise is found from count so many samples back (see
# NUM_SAMPLES of the profile).
NUM_RECENT = 240
# What one wrong point may add to that noise: bones that are further off are errors of the tracker.
MAX_DEVIATION_M = 0.008
# Other lengths are no finger's bones in metres (BONE_RANGE_M of the profile).
MIN_LENGTH_M, MAX_LENGTH_M = 0.003, 0.150
# Mean of |x| of a normal distribution is 0.798 sigma; a bone's length has the noise of two points,
# and a point has it along three axes: v = 3 (mean / 0.798)² / 2.
VARIANCE_OF_DEVIATION = 3.0 * (np.pi / 2.0) / 2.0


@compiled
@no_type_check
def follow_point(before, now, variance_m2):
    """Move a smoothed point, in place, to a new sample of it; NaN is no sample before."""
    squared = 0.0
    for k in range(3):
        squared += (now[k] - before[k]) ** 2
    part = 1.0
    if np.isfinite(squared) and squared > 0.0:
        part = squared / (squared + variance_m2)
        for k in range(3):
            before[k] += part * (now[k] - before[k])
    else:
        before[:] = now


@compiled
@no_type_check
def noise_of_bones(bones_m, keypoints, nodes):
    """Mean square of the noise's length, by how the lengths of bones differ from their mean.

    Of each bone [F, 3, 3], changed in place: how often it was seen, its mean length and the mean
    deviation. Keypoints are [K, 3] of one sample; nodes [F, 4] of knuckle, PIP, DIP and tip, or -1.
    """
    total, count = 0.0, 0
    for finger in range(len(bones_m)):
        for bone in range(3):
            a, b = nodes[finger, bone], nodes[finger, bone + 1]
            one = bones_m[finger, bone]
            squared = np.nan
            if a >= 0 and b >= 0:
                squared = 0.0
                for k in range(3):
                    squared += (keypoints[a, k] - keypoints[b, k]) ** 2
            length = np.sqrt(squared)
            # False for NaN, too.
            if MIN_LENGTH_M <= length <= MAX_LENGTH_M:
                one[0] = min(one[0] + 1.0, NUM_RECENT)
                if one[0] == 1.0:
                    one[1] = length
                off = min(max(length - one[1], -MAX_DEVIATION_M), MAX_DEVIATION_M)
                one[1] += off / one[0]
                one[2] += (abs(off) - one[2]) / one[0]
            if one[0] > 0.0:
                total += one[2]
                count += 1
    return VARIANCE_OF_DEVIATION * (total / max(count, 1)) ** 2


@compiled_once
@no_type_check
def smooth_forward(keypoints, variance_m2):
    """Smooth the nodes of keypoints [T, K, 3] in time, in place; NaN stays, and is passed over."""
    for node in range(keypoints.shape[1]):
        before = keypoints[0, node].copy()
        for t in range(1, len(keypoints)):
            if np.isfinite(keypoints[t, node]).all():
                follow_point(before, keypoints[t, node], variance_m2)
                keypoints[t, node] = before


def smoothed(keypoints_m: np.ndarray, sigma_m: float) -> np.ndarray:
    """Keypoints [T, K, 3] smoothed forwards and backwards; the mean of both has no lag.

    NaN where missing; sigma is that of the tracker's noise, per axis.
    """
    passes = keypoints_m.copy(), keypoints_m[::-1].copy()
    for one in passes:
        smooth_forward(one, 3.0 * sigma_m**2)
    return np.asarray((passes[0] + passes[1][::-1]) / 2)
