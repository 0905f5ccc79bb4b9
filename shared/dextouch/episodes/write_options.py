"""How an episode is written: durability, threads, and what to do when the encoder is too slow."""

from typing import Literal

from pydantic import BaseModel, ConfigDict

from dextouch.episodes.video import VideoSettings

WhenFull = Literal["wait", "drop"]


class WriteOptions(BaseModel):
    """Settings of a writer.

    Attributes:
        sync: every storage chunk survives a power loss; otherwise only what is committed does, and
            everything written survives the death of the process.
        threads: whether images are encoded beside the caller, one thread a camera.
        when_full: of the queue before an encoder: "wait" holds the caller up, "drop" leaves the
            image out and counts it, which is what a live take needs.
        recoverable: whether what was written is kept when the writer is broken off: after an
            exception or Ctrl-C at once, after a kill or on a full disk by `EpisodeStore.recover`.
            None: recordings, but not episodes, since these are made again from their recording.
            False suits whoever can repeat the whole of it, such as an import.
        video: quality of `h264` streams.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    sync: bool = False
    threads: bool = True
    when_full: WhenFull = "wait"
    recoverable: bool | None = None
    video: VideoSettings = VideoSettings()
