"""Store of episodes and recordings: crash-safe writers, random access readers, training windows."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.episodes.files import disk_errors, folder_bytes, replace_file
    from dextouch.episodes.format import (
        COMMIT_FILE,
        GOP_IMAGES,
        KINDS,
        Kind,
        check_id,
        shard_path,
        stream_arrays,
    )
    from dextouch.episodes.local_storage import local_folder
    from dextouch.episodes.reader import EpisodeReader, RecordingReader
    from dextouch.episodes.sources import GroupFiles, LocalGroup
    from dextouch.episodes.store import EpisodeStore
    from dextouch.episodes.trash import TRASH_KINDS, TrashKind
    from dextouch.episodes.video import (
        FULL_FORM,
        GopEncoder,
        ImageForm,
        VideoSettings,
        check_video_size,
        decoder_of_this_thread,
        is_keyframe,
        parameter_sets,
    )
    from dextouch.episodes.window import (
        NativeWindow,
        StreamData,
        Window,
        mean_over_ranges,
        nearest_indices,
        step_ranges,
    )
    from dextouch.episodes.window_codec import decode_window, encode_window
    from dextouch.episodes.write_options import WriteOptions
    from dextouch.episodes.writer import EpisodeWriter
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "files": "disk_errors folder_bytes replace_file",
            "format": "COMMIT_FILE GOP_IMAGES KINDS Kind check_id shard_path stream_arrays",
            "local_storage": "local_folder",
            "reader": "EpisodeReader RecordingReader",
            "sources": "GroupFiles LocalGroup",
            "store": "EpisodeStore",
            "trash": "TRASH_KINDS TrashKind",
            "video": (
                "FULL_FORM GopEncoder ImageForm VideoSettings check_video_size "
                "decoder_of_this_thread is_keyframe parameter_sets"
            ),
            "window": "NativeWindow StreamData Window mean_over_ranges nearest_indices step_ranges",
            "window_codec": "decode_window encode_window",
            "write_options": "WriteOptions",
            "writer": "EpisodeWriter",
        },
    )

__all__ = [
    "COMMIT_FILE",
    "FULL_FORM",
    "GOP_IMAGES",
    "KINDS",
    "TRASH_KINDS",
    "EpisodeReader",
    "EpisodeStore",
    "EpisodeWriter",
    "GopEncoder",
    "GroupFiles",
    "ImageForm",
    "Kind",
    "LocalGroup",
    "NativeWindow",
    "RecordingReader",
    "StreamData",
    "TrashKind",
    "VideoSettings",
    "Window",
    "WriteOptions",
    "care",
    "check_id",
    "check_video_size",
    "decode_window",
    "decoder_of_this_thread",
    "disk_errors",
    "encode_window",
    "folder_bytes",
    "is_keyframe",
    "local_folder",
    "mean_over_ranges",
    "nearest_indices",
    "parameter_sets",
    "replace_file",
    "shard_path",
    "spool",
    "step_ranges",
    "stream_arrays",
]
