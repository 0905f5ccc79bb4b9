"""Store of episodes and recordings: crash-safe writers, random access readers, training windows."""

from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.video import ImageForm, VideoSettings
from dextouch.episodes.window import NativeWindow, StreamData, Window
from dextouch.episodes.write_options import WriteOptions
from dextouch.episodes.writer import EpisodeWriter

__all__ = [
    "EpisodeReader",
    "EpisodeStore",
    "EpisodeWriter",
    "ImageForm",
    "NativeWindow",
    "RecordingReader",
    "StreamData",
    "VideoSettings",
    "Window",
    "WriteOptions",
]
