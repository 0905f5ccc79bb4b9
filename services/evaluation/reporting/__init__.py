"""HTML report of an evaluation: one self-contained page of figures and images."""

from services.evaluation.reporting.page import write_report
from services.evaluation.reporting.pictures import (
    ActionPicture,
    EpisodePicture,
    PredictionPicture,
    ReportPictures,
    action_picture,
    episode_picture,
)

__all__ = [
    "ActionPicture",
    "EpisodePicture",
    "PredictionPicture",
    "ReportPictures",
    "action_picture",
    "episode_picture",
    "write_report",
]
