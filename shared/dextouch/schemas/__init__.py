"""HTTP bodies of the services as pydantic models, independent of the web framework."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.schemas.episodes import (
        ID_PATTERN,
        CatalogHours,
        ClockMethod,
        ClockReport,
        ClockWarning,
        Domain,
        EpisodeAttributes,
        EpisodeDetail,
        EpisodeList,
        EpisodeSummary,
        HoursRow,
        LineageEntry,
        Matrix,
        Origin,
        StoredAnchor,
        StoreId,
        Verification,
        json_ready,
        matrix_rows,
    )
    from dextouch.schemas.health import Health, Readiness
    from dextouch.schemas.problems import (
        CLASS_OF_STATUS,
        PROBLEM_MEDIA_TYPE,
        Problem,
        error_from_problem,
        first_problems,
        problem_from_error,
        status_of,
    )
    from dextouch.schemas.recordings import (
        ID_TAKEN,
        BatchReceipt,
        ExpireUploads,
        FinishRecording,
        LedgerEntry,
        RecordingAttributes,
        RecordingList,
        RecordingStatus,
        RecordingSummary,
        UploadList,
        UploadSummary,
    )
    from dextouch.schemas.rollout_codec import (
        RolloutAnswer,
        RolloutOrigin,
        decode_answer,
        decode_observation,
        decode_start,
        encode_answer,
        encode_observation,
        encode_start,
        start_from,
    )
    from dextouch.schemas.rollouts import (
        EVERYTHING,
        MAX_SEED,
        ActionKind,
        Doubt,
        ForkRequest,
        Observation,
        ReturnSelector,
        RolloutInfo,
        RolloutStart,
        StartRequest,
        WorldDescription,
        WorldKind,
        WorldList,
        check_observation,
    )
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "episodes": (
                "CatalogHours ClockMethod ClockReport ClockWarning Domain EpisodeAttributes "
                "EpisodeDetail EpisodeList EpisodeSummary HoursRow ID_PATTERN LineageEntry Matrix "
                "Origin StoreId StoredAnchor Verification json_ready matrix_rows"
            ),
            "health": "Health Readiness",
            "problems": (
                "CLASS_OF_STATUS PROBLEM_MEDIA_TYPE Problem error_from_problem first_problems "
                "problem_from_error status_of"
            ),
            "recordings": (
                "BatchReceipt ExpireUploads FinishRecording ID_TAKEN LedgerEntry "
                "RecordingAttributes RecordingList RecordingStatus RecordingSummary UploadList "
                "UploadSummary"
            ),
            "rollout_codec": (
                "RolloutAnswer RolloutOrigin decode_answer decode_observation decode_start "
                "encode_answer encode_observation encode_start start_from"
            ),
            "rollouts": (
                "ActionKind Doubt EVERYTHING ForkRequest MAX_SEED Observation ReturnSelector "
                "RolloutInfo RolloutStart StartRequest WorldDescription WorldKind WorldList "
                "check_observation"
            ),
        },
    )

__all__ = [
    "CLASS_OF_STATUS",
    "EVERYTHING",
    "ID_PATTERN",
    "ID_TAKEN",
    "MAX_SEED",
    "PROBLEM_MEDIA_TYPE",
    "ActionKind",
    "BatchReceipt",
    "CatalogHours",
    "ClockMethod",
    "ClockReport",
    "ClockWarning",
    "Domain",
    "Doubt",
    "EpisodeAttributes",
    "EpisodeDetail",
    "EpisodeList",
    "EpisodeSummary",
    "ExpireUploads",
    "FinishRecording",
    "ForkRequest",
    "Health",
    "HoursRow",
    "LedgerEntry",
    "LineageEntry",
    "Matrix",
    "Observation",
    "Origin",
    "Problem",
    "Readiness",
    "RecordingAttributes",
    "RecordingList",
    "RecordingStatus",
    "RecordingSummary",
    "ReturnSelector",
    "RolloutAnswer",
    "RolloutInfo",
    "RolloutOrigin",
    "RolloutStart",
    "StartRequest",
    "StoreId",
    "StoredAnchor",
    "UploadList",
    "UploadSummary",
    "Verification",
    "WorldDescription",
    "WorldKind",
    "WorldList",
    "check_observation",
    "decode_answer",
    "decode_observation",
    "decode_start",
    "encode_answer",
    "encode_observation",
    "encode_start",
    "error_from_problem",
    "first_problems",
    "json_ready",
    "matrix_rows",
    "problem_from_error",
    "start_from",
    "status_of",
]
