"""HTTP bodies of the services as pydantic models, independent of the web framework."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.schemas.episodes import ID_PATTERN as ID_PATTERN
    from dextouch.schemas.episodes import CatalogHours as CatalogHours
    from dextouch.schemas.episodes import ClockMethod as ClockMethod
    from dextouch.schemas.episodes import ClockReport as ClockReport
    from dextouch.schemas.episodes import ClockWarning as ClockWarning
    from dextouch.schemas.episodes import Domain as Domain
    from dextouch.schemas.episodes import EpisodeAttributes as EpisodeAttributes
    from dextouch.schemas.episodes import EpisodeDetail as EpisodeDetail
    from dextouch.schemas.episodes import EpisodeList as EpisodeList
    from dextouch.schemas.episodes import EpisodeSummary as EpisodeSummary
    from dextouch.schemas.episodes import HoursRow as HoursRow
    from dextouch.schemas.episodes import LineageEntry as LineageEntry
    from dextouch.schemas.episodes import Matrix as Matrix
    from dextouch.schemas.episodes import Origin as Origin
    from dextouch.schemas.episodes import StoredAnchor as StoredAnchor
    from dextouch.schemas.episodes import StoreId as StoreId
    from dextouch.schemas.episodes import Verification as Verification
    from dextouch.schemas.episodes import is_rollout as is_rollout
    from dextouch.schemas.episodes import json_ready as json_ready
    from dextouch.schemas.episodes import matrix_rows as matrix_rows
    from dextouch.schemas.observations import EVERYTHING as EVERYTHING
    from dextouch.schemas.observations import Observation as Observation
    from dextouch.schemas.observations import ReturnSelector as ReturnSelector
    from dextouch.schemas.observations import RolloutAnswer as RolloutAnswer
    from dextouch.schemas.observations import RolloutOrigin as RolloutOrigin
    from dextouch.schemas.observations import RolloutStart as RolloutStart
    from dextouch.schemas.observations import answer_parts as answer_parts
    from dextouch.schemas.observations import check_observation as check_observation
    from dextouch.schemas.observations import decode_answer as decode_answer
    from dextouch.schemas.observations import decode_observation as decode_observation
    from dextouch.schemas.observations import decode_start as decode_start
    from dextouch.schemas.observations import encode_observation as encode_observation
    from dextouch.schemas.observations import encode_start as encode_start
    from dextouch.schemas.observations import start_from as start_from
    from dextouch.schemas.observations import validate_fields as validate_fields
    from dextouch.schemas.problems import CLASS_OF_STATUS as CLASS_OF_STATUS
    from dextouch.schemas.problems import MAX_NAMED as MAX_NAMED
    from dextouch.schemas.problems import PROBLEM_MEDIA_TYPE as PROBLEM_MEDIA_TYPE
    from dextouch.schemas.problems import Health as Health
    from dextouch.schemas.problems import Problem as Problem
    from dextouch.schemas.problems import Readiness as Readiness
    from dextouch.schemas.problems import error_from_problem as error_from_problem
    from dextouch.schemas.problems import first_problems as first_problems
    from dextouch.schemas.problems import problem_from_error as problem_from_error
    from dextouch.schemas.problems import status_of as status_of
    from dextouch.schemas.recordings import ID_TAKEN as ID_TAKEN
    from dextouch.schemas.recordings import BatchReceipt as BatchReceipt
    from dextouch.schemas.recordings import ExpireUploads as ExpireUploads
    from dextouch.schemas.recordings import FinishRecording as FinishRecording
    from dextouch.schemas.recordings import LedgerEntry as LedgerEntry
    from dextouch.schemas.recordings import RecordingAttributes as RecordingAttributes
    from dextouch.schemas.recordings import RecordingList as RecordingList
    from dextouch.schemas.recordings import RecordingStatus as RecordingStatus
    from dextouch.schemas.recordings import RecordingSummary as RecordingSummary
    from dextouch.schemas.recordings import UploadList as UploadList
    from dextouch.schemas.recordings import UploadSummary as UploadSummary
    from dextouch.schemas.rollouts import MAX_SEED as MAX_SEED
    from dextouch.schemas.rollouts import ActionKind as ActionKind
    from dextouch.schemas.rollouts import Doubt as Doubt
    from dextouch.schemas.rollouts import ForkRequest as ForkRequest
    from dextouch.schemas.rollouts import RolloutInfo as RolloutInfo
    from dextouch.schemas.rollouts import StartRequest as StartRequest
    from dextouch.schemas.rollouts import WorldDescription as WorldDescription
    from dextouch.schemas.rollouts import WorldKind as WorldKind
    from dextouch.schemas.rollouts import WorldList as WorldList
    from dextouch.schemas.station import CameraList as CameraList
    from dextouch.schemas.station import CameraLive as CameraLive
    from dextouch.schemas.station import CauseCode as CauseCode
    from dextouch.schemas.station import DeviceHealth as DeviceHealth
    from dextouch.schemas.station import HealthCause as HealthCause
    from dextouch.schemas.station import HealthEvent as HealthEvent
    from dextouch.schemas.station import HealthEvents as HealthEvents
    from dextouch.schemas.station import HealthLevel as HealthLevel
    from dextouch.schemas.station import RaisedFinding as RaisedFinding
    from dextouch.schemas.station import RecorderAction as RecorderAction
    from dextouch.schemas.station import RecorderState as RecorderState
    from dextouch.schemas.station import RecorderStatus as RecorderStatus
    from dextouch.schemas.station import SaveTake as SaveTake
    from dextouch.schemas.station import SharedLink as SharedLink
    from dextouch.schemas.station import StaleCode as StaleCode
    from dextouch.schemas.station import StationHealth as StationHealth
    from dextouch.schemas.station import StreamHealth as StreamHealth
    from dextouch.schemas.station import StreamTake as StreamTake
    from dextouch.schemas.station import TakeCheck as TakeCheck
    from dextouch.schemas.station import TakeName as TakeName
    from dextouch.schemas.station import TakeProblem as TakeProblem
    from dextouch.schemas.station import TakePrompt as TakePrompt
    from dextouch.schemas.station import UploadStatus as UploadStatus
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
