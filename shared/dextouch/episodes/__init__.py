"""Store of episodes and recordings: crash-safe writers, random access readers, training windows."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.episodes import care as care
    from dextouch.episodes import needs as needs
    from dextouch.episodes import spool as spool
    from dextouch.episodes.content import ContentDigest as ContentDigest
    from dextouch.episodes.files import disk_errors as disk_errors
    from dextouch.episodes.files import folder_bytes as folder_bytes
    from dextouch.episodes.files import replace_file as replace_file
    from dextouch.episodes.format import COMMIT_FILE as COMMIT_FILE
    from dextouch.episodes.format import GOP_IMAGES as GOP_IMAGES
    from dextouch.episodes.format import KINDS as KINDS
    from dextouch.episodes.format import Kind as Kind
    from dextouch.episodes.format import check_id as check_id
    from dextouch.episodes.format import shard_path as shard_path
    from dextouch.episodes.format import stream_arrays as stream_arrays
    from dextouch.episodes.h264_headers import first_gap as first_gap
    from dextouch.episodes.image_codecs import FULL_FORM as FULL_FORM
    from dextouch.episodes.image_codecs import GopEncoder as GopEncoder
    from dextouch.episodes.image_codecs import ImageForm as ImageForm
    from dextouch.episodes.image_codecs import VideoSettings as VideoSettings
    from dextouch.episodes.image_codecs import check_group as check_group
    from dextouch.episodes.image_codecs import check_video_size as check_video_size
    from dextouch.episodes.image_codecs import decoder_of_this_thread as decoder_of_this_thread
    from dextouch.episodes.image_codecs import is_keyframe as is_keyframe
    from dextouch.episodes.image_codecs import parameter_sets as parameter_sets
    from dextouch.episodes.object_clicks import ClickedPoses as ClickedPoses
    from dextouch.episodes.object_clicks import clicked_poses as clicked_poses
    from dextouch.episodes.object_clicks import first_camera as first_camera
    from dextouch.episodes.object_clicks import listed_objects as listed_objects
    from dextouch.episodes.object_poses import ObjectSource as ObjectSource
    from dextouch.episodes.object_poses import ObjectTrack as ObjectTrack
    from dextouch.episodes.object_poses import has_object_poses as has_object_poses
    from dextouch.episodes.object_poses import object_track as object_track
    from dextouch.episodes.reader import EpisodeReader as EpisodeReader
    from dextouch.episodes.reader import RecordingReader as RecordingReader
    from dextouch.episodes.rollout_episode import write_rollout as write_rollout
    from dextouch.episodes.sources import GroupFiles as GroupFiles
    from dextouch.episodes.sources import LocalGroup as LocalGroup
    from dextouch.episodes.splits import SPLITS as SPLITS
    from dextouch.episodes.splits import Split as Split
    from dextouch.episodes.splits import is_in as is_in
    from dextouch.episodes.splits import recording_of as recording_of
    from dextouch.episodes.splits import scene_fraction as scene_fraction
    from dextouch.episodes.splits import scene_of as scene_of
    from dextouch.episodes.splits import split_by_scene as split_by_scene
    from dextouch.episodes.splits import split_of as split_of
    from dextouch.episodes.splits import split_of_scene as split_of_scene
    from dextouch.episodes.store import EpisodeStore as EpisodeStore
    from dextouch.episodes.store import local_folder as local_folder
    from dextouch.episodes.stream_writer import WriteOptions as WriteOptions
    from dextouch.episodes.table import TRUE_ORIGINS as TRUE_ORIGINS
    from dextouch.episodes.table import EpisodeGrid as EpisodeGrid
    from dextouch.episodes.table import data_hash as data_hash
    from dextouch.episodes.table import is_rejected as is_rejected
    from dextouch.episodes.table import select_episodes as select_episodes
    from dextouch.episodes.trash import TRASH_KINDS as TRASH_KINDS
    from dextouch.episodes.trash import TrashKind as TrashKind
    from dextouch.episodes.window import NativeWindow as NativeWindow
    from dextouch.episodes.window import StreamData as StreamData
    from dextouch.episodes.window import Window as Window
    from dextouch.episodes.window import decode_window as decode_window
    from dextouch.episodes.window import encode_window as encode_window
    from dextouch.episodes.window import mean_over_ranges as mean_over_ranges
    from dextouch.episodes.window import step_ranges as step_ranges
    from dextouch.episodes.writer import EpisodeWriter as EpisodeWriter
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
