"""Tables, charts and requirements of the world-model benchmark."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement
from benchmarks.report import ResultTable
from benchmarks.world_model.rollouts import RolloutError

if TYPE_CHECKING:
    from services.world_model.network.configuration import Precision, Sampler

COPY_FIRST: Final = "copy-first"
MAX_CHUNK_MS: Final = 50.0


@dataclass(frozen=True)
class Variant:
    """A sampling setting; `recomputed`: nothing is shared by its steps."""

    steps: int
    sampler: "Sampler" = "euler"
    precision: "Precision" = "float32"
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


def cost_table(costs_ms: Mapping[str, Figure], served: str) -> ResultTable:
    """Time of one rollout's chunk by requested images and batch size."""
    return ResultTable(
        f"{served}: a chunk of one rollout, by requested images and batch size",
        ("requested", "ms"),
        [(name, figure.text()) for name, figure in costs_ms.items()],
    )


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
                Point(
                    label=name,
                    time=times_ms[name].median,
                    time_low=times_ms[name].low,
                    time_high=times_ms[name].high,
                    error=getattr(error, key),
                    is_ours=name == served,
                )
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
        Requirement("a chunk, all images", times_ms[served].median, "at most", MAX_CHUNK_MS, "ms"),
        Requirement("image error, share of copy-first's", image, "at most", 1.0),
        Requirement("touch error, share of copy-first's", touch, "at most", 1.0),
    ]
