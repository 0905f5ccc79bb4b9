"""A folder for caches in; this process ready for lerobot, offline and quiet, and for our store."""

import os
import sys
import warnings
from pathlib import Path

_TAKES = Path(__file__).resolve().parents[2] / "unit" / "bridges"


def enter(cache: Path) -> None:
    """Prepare the process; to be called before anything imports lerobot.

    Args:
        cache: where lerobot keeps what it copies out of datasets; the caller removes it.
    """
    os.environ.update(
        HF_HOME=str(cache),
        HF_HUB_OFFLINE="1",
        HF_DATASETS_OFFLINE="1",
        HF_DATASETS_DISABLE_PROGRESS_BARS="1",
        SVT_LOG="1",
    )
    # lerobot switches the bars off and on again by itself, and datasets remarks on that.
    warnings.filterwarnings("ignore", message="Cannot (enable|disable) progress bars")
    sys.path.append(str(_TAKES))
    import av.logging

    av.logging.set_libav_level(av.logging.ERROR)
    _let_reformat_take_threads()


def _let_reformat_take_threads() -> None:
    """Let PyAV 15, which LeRobot asks for, take a word of PyAV 18 that our store says.

    Without that word `VideoReformatter.reformat` uses one thread, which is what the store wants.
    """
    import av.video.reformatter as module

    if "threads" in (module.VideoReformatter.reformat.__doc__ or ""):
        return

    class VideoReformatter(module.VideoReformatter):
        def reformat(self, *args: object, threads: int = 1, **kwargs: object) -> object:
            if threads != 1:
                raise NotImplementedError(f"PyAV 15: got {threads} threads, has one")
            return super().reformat(*args, **kwargs)

    module.VideoReformatter = VideoReformatter
