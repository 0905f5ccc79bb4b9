"""Episodes and recordings on disk: write them whole, read slices and windows of them."""

from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.window import NativeWindow, StreamData, Window
from dextouch.episodes.writer import EpisodeWriter

__all__ = [
    "EpisodeReader",
    "EpisodeStore",
    "EpisodeWriter",
    "NativeWindow",
    "RecordingReader",
    "StreamData",
    "Window",
]
