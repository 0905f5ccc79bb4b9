"""Episodes and recordings on disk: write them whole, read slices and windows of them."""

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
