"""Tables, charts and requirements of the world-model benchmark."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_least, at_most
from benchmarks.report import ResultTable
from benchmarks.world_model.rollouts import RolloutError
from dextouch.schemas import CHUNK_STEPS
from services.world_model.network.configuration import Precision, Sampler

COPY_FIRST: Final = "copy-first"
MAX_CHUNK_MS: Final = 50.0
# Requirements on the state model as served: one rollout, and sixteen in a batch.
MAX_STATE_CHUNK_MS: Final = {"no image": 7.0, "the last image": 14.0, "all images": 45.0}
MIN_BATCH_SPEEDUP: Final = 2.0
STATE_BATCHES: Final = (1, 4, 16)
IMAGES_PER_CHUNK: Final = {"no image": 0, "the last image": 1, "all images": CHUNK_STEPS}


@dataclass(frozen=True)
class Variant:
    """A sampling setting; `recomputed`: nothing is shared by its steps."""

    steps: int
    sampler: Sampler = "euler"
    precision: Precision = "float32"
    recomputed: bool = False

    @property
    def name(self) -> str:
        """Name in tables and charts."""
        solver = "UniPC" if self.sampler == "unipc" else "Euler"
        steps = f"{self.steps} {solver} step{'s' if self.steps > 1 else ''}"
        return f"{steps}, {self.precision}{', context recomputed' * self.recomputed}"


def error_table(
    times_ms: Mapping[str, Figure],
    errors: Mapping[str, RolloutError],
    served: str,
    num_episodes: int,
) -> ResultTable:
    """Time of a chunk of 16 steps and errors of whole rollouts."""
    return ResultTable(
        f"{num_episodes} held-out rollouts, chained, all images; RMS errors over all steps",
        ("world", "ms a chunk", "image (of 255)", "touch (kPa)", "contact F1"),
        [
            (
                name + (" (as served)" if name == served else ""),
                times_ms[name].text(),
                f"{error.image_levels:.2f}",
                f"{error.touch_kpa:.2f}",
                f"{error.contact_f1:.2f}",
            )
            for name, error in errors.items()
        ],
    )


def asked_name(asked: str, batch: int) -> str:
    """Name of the figure for requested images and a batch size."""
    return f"{asked}, batch of {batch}"


def state_model_table(costs_ms: Mapping[str, Figure], name: str) -> ResultTable:
    """Time and image rate of the state model by requested images and batch size."""
    rows = []
    for batch in STATE_BATCHES:
        for asked, num_images in IMAGES_PER_CHUNK.items():
            figure = costs_ms[asked_name(asked, batch)]
            rate = f"{1e3 * num_images / figure.median:.0f}" if num_images else ""
            rows.append((asked, str(batch), figure.text(), rate))
    return ResultTable(
        f"State model {name}: a chunk of one rollout, by requested images and batch size",
        ("requested", "batch", "ms a chunk", "images a second"),
        rows,
    )


def state_model_requirements(costs_ms: Mapping[str, Figure]) -> list[Requirement]:
    """Requirements on single rollouts, and on batches compared with them."""
    chunks = [
        at_most(
            f"state model, a chunk, {asked}", costs_ms[asked_name(asked, 1)].median, bound_ms, "ms"
        )
        for asked, bound_ms in MAX_STATE_CHUNK_MS.items()
    ]
    single, batch = (costs_ms[asked_name("all images", count)] for count in (1, 16))
    speedup = single.over(batch).median
    what = "state model, all images, throughput of a batch of 16 over single rollouts"
    return [*chunks, at_least(what, speedup, MIN_BATCH_SPEEDUP)]


def panels(
    times_ms: Mapping[str, Figure], errors: Mapping[str, RolloutError], served: str
) -> list[Panel]:
    """Time of a chunk against image error and against touch error."""
    kinds = (
        ("Imagined images", "RMS error (levels of 255)", "image_levels"),
        ("Imagined touch", "RMS error (kPa)", "touch_kpa"),
    )
    return [
        Panel(
            title,
            "processor ms a chunk",
            label,
            [
                Point.of(name, times_ms[name], getattr(error, key), is_ours=name == served)
                for name, error in errors.items()
            ],
        )
        for title, label, key in kinds
    ]


def requirements(
    times_ms: Mapping[str, Figure],
    errors: Mapping[str, RolloutError],
    served: str,
) -> list[Requirement]:
    """Requirements on speed, and on errors relative to repeating the first step."""
    ours, copied = errors[served], errors[COPY_FIRST]
    image, touch = ours.image_levels / copied.image_levels, ours.touch_kpa / copied.touch_kpa
    return [
        at_most("a chunk, all images", times_ms[served].median, MAX_CHUNK_MS, "ms"),
        at_most("image error, share of copy-first's", image, 1.0),
        at_most("touch error, share of copy-first's", touch, 1.0),
    ]
