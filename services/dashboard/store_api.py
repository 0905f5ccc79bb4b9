"""The episode store's lists in, the newest takes as the page shows them out."""

from pydantic import ValidationError

from dextouch.errors import UnavailableError
from dextouch.schemas.episodes import EpisodeList
from dextouch.schemas.recordings import RecordingList
from services.dashboard.views import TakeView

RECORDINGS_PATH = "/v1/recordings"
EPISODES_PATH = "/v1/episodes"


def take_views(recordings: object, episodes: object, *, newest: int) -> list[TakeView]:
    """The last `newest` of both lists, which the store orders by id, latest first.

    Raises:
        UnavailableError: lists in a form this version does not know.
    """
    try:
        raw = RecordingList.model_validate(recordings).recordings
        done = EpisodeList.model_validate(episodes).episodes
    except ValidationError as error:
        raise UnavailableError(f"episode_store: lists of an unknown form ({error})") from error
    outcomes = {True: "success", False: "failure", None: "not judged"}
    return [
        TakeView(
            kind="episode",
            name=item.episode_id,
            task=item.task,
            domain=item.domain,
            outcome=f"{outcomes[item.success]}, {item.num_steps} steps",
        )
        for item in reversed(done[-newest:])
    ] + [
        TakeView(
            kind="recording",
            name=item.recording_id,
            task=item.task,
            domain=item.domain,
            outcome=f"{sum(item.num_samples.values())} samples in {len(item.num_samples)} streams",
        )
        for item in reversed(raw[-newest:])
    ]
