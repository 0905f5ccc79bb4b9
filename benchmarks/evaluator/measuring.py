"""Errors of an imagined rollout relative to the true one: taxel contact and images, by chunk."""

from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from benchmarks.evaluator.playing import ImaginedRollout, TrueRollout
from dextouch.geometry import apply, invert, transform_from_pose
from dextouch.hands.actions import AnchorPoses, poses_from_actions
from dextouch.metrics.image import PEAK, decibels
from dextouch.metrics.tactile import mse
from dextouch.schemas import CHUNK_STEPS
from dextouch.tactile import in_contact
from services.evaluation.prediction_scenes import warp_over_table

# Margin in pixels around an object's box that belongs to its region.
_MARGIN_PX: Final = 1
Row = dict[str, list[list[float]]]


def chunk_figures(
    real: TrueRollout,
    imagined: ImaginedRollout,
    anchor: AnchorPoses,
    K_head: np.ndarray,
    first_image: np.ndarray,
    boxes_m: np.ndarray,
) -> Row:
    """Contact counts of imagined and copied touch, and PSNR at the end of every chunk.

    Counts are taxels in contact [in both, imagined, true]. The copy is the true touch at the
    chunk's start, which the world model does not get. PSNR is [imagined, warped] for the whole
    image and for the region where objects are or were; warped is the rollout's first image,
    warped by the known motion of the camera over the table.
    """
    cameras = poses_from_actions(real.actions, anchor).Ts_world_camera_head
    found: Row = {"contact": [], "contact_of_copy": [], "psnr": [], "psnr_of_objects": []}
    for index, image in enumerate(real.images_of_chunks):
        steps = slice(1 + index * CHUNK_STEPS, 1 + (index + 1) * CHUNK_STEPS)
        truth = real.tactile_kpa[steps]
        copied = np.broadcast_to(real.tactile_kpa[steps.start - 1], truth.shape)
        found["contact"].append(contact_counts(imagined.tactile_kpa[steps], truth))
        found["contact_of_copy"].append(contact_counts(copied, truth))
        T_world_now = cameras[steps.stop - 2]
        warped = warp_over_table(first_image, K_head, anchor.T_world_camera_head, T_world_now)
        region = object_region(
            np.concatenate([real.object_poses[0], real.object_poses[index + 1]]),
            np.concatenate([boxes_m, boxes_m]),
            K_head,
            T_world_now,
            image.shape[:2],
        )
        pair = (imagined.images_of_chunks[index], warped)
        found["psnr"].append([psnr_within(one, image) for one in pair])
        if region.any():
            found["psnr_of_objects"].append([psnr_within(one, image, region) for one in pair])
    return found


def contact_counts(predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> list[float]:
    """Taxels in contact: in both, predicted, true. F1 is 2·both / (predicted + true)."""
    told, came = in_contact(predicted_kpa), in_contact(true_kpa)
    return [float((told & came).sum()), float(told.sum()), float(came.sum())]


def psnr_within(
    predicted: np.ndarray, true: np.ndarray, region: np.ndarray | slice = slice(None)
) -> float:
    """PSNR in dB over the pixels of a region, or of the whole image."""
    error = predicted[region].astype(np.float64) - true[region].astype(np.float64)
    return float(decibels(np.mean(error**2), peak=PEAK))


def object_region(
    object_poses: np.ndarray,
    boxes_m: np.ndarray,
    K: np.ndarray,
    T_world_camera: np.ndarray,
    shape_px: tuple[int, int],
) -> Bool[np.ndarray, "h w"]:
    """Pixels in the rectangles around boxes [objects, 6] of objects at poses [objects, 7]."""
    region = np.zeros(shape_px, dtype=bool)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    for pose, box in zip(object_poses, boxes_m, strict=True):
        corners = apply(transform_from_pose(pose), box[:3] + signs * box[3:])
        seen = apply(invert(T_world_camera), corners)
        if (seen[:, 2] <= 0).any():
            continue
        pixels = (seen / seen[:, 2:]) @ K.T
        low = np.floor(pixels[:, :2].min(axis=0) - _MARGIN_PX).astype(int).clip(0)
        high = np.ceil(pixels[:, :2].max(axis=0) + _MARGIN_PX).astype(int).clip(0)
        region[low[1] : high[1], low[0] : high[0]] = True
    return region


def wrong_action_figures(
    real: TrueRollout, own: ImaginedRollout, wrong: ImaginedRollout
) -> dict[str, list[float] | list[list[float]]]:
    """Errors [own, wrong] of predictions for a rollout's own actions and for another's.

    Squared error of touch in kPa², mean over all steps, and PSNR at the end of every chunk.
    """
    both = (own, wrong)
    return {
        "touch_error": [mse(predicted_kpa=o.tactile_kpa, true_kpa=real.tactile_kpa) for o in both],
        "psnr": [
            [psnr_within(one.images_of_chunks[index], image) for one in both]
            for index, image in enumerate(real.images_of_chunks)
        ],
    }


def sharpness_of_chunks(real: TrueRollout, imagined: ImaginedRollout) -> list[list[float]]:
    """Mean absolute Laplacian [imagined, true] of the image at the end of every chunk."""
    pair = (imagined.images_of_chunks, real.images_of_chunks)
    return np.stack([sharpness(one.astype(np.float64)) for one in pair], axis=1).tolist()


def sharpness(images: Float64[np.ndarray, "n h w 3"]) -> Float64[np.ndarray, " n"]:
    """Mean absolute Laplacian (five points) of images, inside their border."""
    centre = images[:, 1:-1, 1:-1]
    across = images[:, 1:-1, 2:] + images[:, 1:-1, :-2]
    down = images[:, 2:, 1:-1] + images[:, :-2, 1:-1]
    return np.asarray(np.abs(across + down - 4.0 * centre).mean(axis=(1, 2, 3)))
