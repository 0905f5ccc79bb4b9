"""Figures and pictures of a run in; one self-contained HTML page out."""

from services.evaluation.reporting.page import write_report
from services.evaluation.reporting.pictures import (
    ActionPicture,
    EpisodePicture,
    PredictionPicture,
    ReportPictures,
)

__all__ = [
    "ActionPicture",
    "EpisodePicture",
    "PredictionPicture",
    "ReportPictures",
    "write_report",
]
