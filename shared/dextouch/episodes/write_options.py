"""Options of an episode writer: durability, encoder threads and backpressure."""

from typing import Literal

from dextouch.episodes.video import VideoSettings
from dextouch.frozen_model import FrozenModel

WhenFull = Literal["wait", "drop"]


class WriteOptions(FrozenModel):
    """Settings of a writer.

    Attributes:
        sync: sync every storage chunk to disk. Otherwise only committed groups survive a power
            loss, while everything written survives a crash of the process.
        threads: whether images are encoded in background threads, one per camera.
        when_full: backpressure of the encoder queue: "wait" blocks the caller, "drop" drops and
            counts the image, as a live take needs.
        recoverable: whether an interrupted group is kept: at once after an exception or Ctrl-C, by
            `EpisodeStore.recover` after a kill or on a full disk. None: recordings only, since
            episodes can be recomputed from their recording. False suits writers that can start
            over, such as an import.
        video: quality of `h264` streams.
    """

    sync: bool = False
    threads: bool = True
    when_full: WhenFull = "wait"
    recoverable: bool | None = None
    video: VideoSettings = VideoSettings()
