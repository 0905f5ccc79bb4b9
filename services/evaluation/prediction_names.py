"""Names of the metrics and baselines of predictions, for command lines."""

from typing import Final

# What every figure stands beside, in the order of tables.
BASELINES: Final = {
    "copy": "the first step, repeated",
    "warp": "the first image, warped by the known motion of the camera over the table",
    "zero": "no touch at all",
    "codec": "the truth, encoded and decoded by the model: the limit",
    "other_take": "the model, given the actions of another take of the task at the same step",
    "hold": "the model, given actions in which nothing moves",
    "hands_still": "the model, given actions in which only the head moves",
    "no_instruction": "the model, given no instruction",
    "other_instruction": "the model, given the instruction of another task",
    "true_images": "the true images, measured in the same way: the error of the measurement",
}


# Instructions matter to worlds that read them, and cost two predictions more.
DEFAULT_BASELINES: Final = tuple(name for name in BASELINES if "instruction" not in name)

# As in all_metrics of services.evaluation.prediction.
METRIC_NAMES: Final = (
    "psnr", "ssim", "trajectory_accuracy", "geometry_error", "tactile_psnr", "tactile_ssim",
    "tactile_mse", "tactile_mae", "contact_mae", "contact_iou", "contact_f1", "pad_contact_f1",
    "object_error", "lpips", "aesthetic_quality", "image_quality", "jepa_similarity",
    "subject_consistency", "semantic_alignment", "tactile_lpips",
)  # fmt: skip
