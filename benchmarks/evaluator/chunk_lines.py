"""Lines of chained touch and images by chunk, for scripts only."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from benchmarks.evaluator.drawn import Drawn, Rolled, Sampling, undefined

_IMAGES = ("psnr", "psnr_of_objects")
_COPY, _CONTEXT = "chained contact F1 less copy", "chained contact F1 over F1 with true context"
_WHERE = "worst chunk where anything moves"


def f1(counts: np.ndarray) -> Float64[np.ndarray, "*batch"]:
    """F1 of contact counts [..., 3]: in both, predicted, true; 1 where nothing touches at all."""
    both, total = counts[..., 0], counts[..., 1] + counts[..., 2]
    return np.asarray(np.where(total > 0, 2 * both / np.maximum(total, 1), 1.0))


def chunk_figures_drawn(sampling: Sampling, scripts: Sequence[Rolled]) -> list[Drawn]:
    """All lines of the chunks of one training seed."""
    contact, images = _contact(sampling, scripts), _images(sampling, scripts)
    return [*contact, *images, _sharpness(sampling, scripts)]


def _contact(sampling: Sampling, scripts: Sequence[Rolled]) -> list[Drawn]:
    """F1 of moving chunks; contacts of all rollouts are pooled by chunk index."""
    names = (f"{_COPY}, {_WHERE}", f"{_CONTEXT}, {_WHERE}")
    bounds = (0.0, 0.85)
    mine = [one for one in scripts if "true context" in one.rows]
    moves = moving(mine)
    if not moves.any():
        return [undefined(what, ("at least", b)) for what, b in zip(names, bounds, strict=True)]
    chained, copied, context = (
        [f1(total[..., moves.any(axis=0), :]) for total in sampling.sums(counts, mine)]
        for counts in contact_counts_of(mine)
    )
    less = [ours - theirs for ours, theirs in zip(chained, copied, strict=True)]
    # A share of 1 where neither is right about anything.
    shares = [
        np.where(theirs > 0, ours / np.where(theirs > 0, theirs, 1.0), 1.0)
        for ours, theirs in zip(chained, context, strict=True)
    ]
    return [
        Drawn(what, float(value.min()), draws.min(axis=1), len(mine), ("at least", bound))
        for what, (value, draws), bound in zip(names, (less, shares), bounds, strict=True)
    ]


def moving(scripts: Sequence[Rolled]) -> np.ndarray:
    """Whether anything moves, [rollouts, chunks]."""
    return np.array([one.rows["true context"]["moves"] for one in scripts], dtype=bool)


def contact_counts_of(scripts: Sequence[Rolled]) -> list[np.ndarray]:
    """Counts [rollouts, chunks, 3] of chained, copied and true-context touch where things move."""
    moves = moving(scripts)[..., None]
    rows = (("imagined", "contact"), ("imagined", "contact_of_copy"), ("true context", "contact"))
    return [
        np.where(moves, np.array([one.rows[kind][name] for one in scripts]), 0.0)
        for kind, name in rows
    ]


def _images(sampling: Sampling, scripts: Sequence[Rolled]) -> list[Drawn]:
    """PSNR of whole images in the worst chunk, and relative to the warped start around objects."""
    what = "chained image, worst chunk"
    around = "chained image less warped start where objects are or were, worst of chunks 2 to 5"
    found = []
    for name, text, bound, first in ((_IMAGES[0], what, 25.0, 0), (_IMAGES[1], around, 4.0, 1)):
        whole, both = image_figures(scripts, name)
        if not whole:
            found.append(undefined(text, ("at least", bound)))
            continue
        gains = both[..., 0] - (both[..., 1] if first else 0.0)
        means = [
            sampling.mean(text, column, whole, ("at least", bound)) for column in gains.T[first:]
        ]
        value = min(one.value for one in means)
        draws = np.stack([one.draws for one in means]).min(axis=0)
        found.append(Drawn(text, value, draws, len(whole), ("at least", bound), "dB"))
    return found


def image_figures(scripts: Sequence[Rolled], name: str) -> tuple[list[Rolled], np.ndarray]:
    """Scripts whose every chunk has this figure, and PSNR [rollouts, chunks, 2] of them."""
    rows = [(one, one.rows["imagined"]) for one in scripts]
    whole = [one for one, row in rows if len(row[name]) == len(row["psnr"])]
    return whole, np.array([one.rows["imagined"][name] for one in whole])


def _sharpness(sampling: Sampling, scripts: Sequence[Rolled]) -> Drawn:
    what = "sharpness of chained images as a share of the truth"
    mine = [one for one in scripts if "sharpness" in one.rows]
    if not mine:
        return undefined(what, ("at least", 0.8))
    values = np.array([one.rows["sharpness"]["sharpness"] for one in mine]).sum(axis=1)
    shares = [
        total[..., 0] / np.maximum(total[..., 1], 1e-9) for total in sampling.sums(values, mine)
    ]
    return Drawn(what, float(shares[0]), shares[1], len(mine), ("at least", 0.8))


def chunk_rows(task: str, scripts: Sequence[Rolled]) -> list[dict[str, Any]]:
    """Contact F1, PSNR and sharpness of every chunk, each with its baselines."""
    if not scripts:
        return []
    rows: list[dict[str, Any]] = [
        {"task": task, "chunk": 1 + chunk}
        for chunk in range(len(scripts[0].rows["imagined"]["psnr"]))
    ]
    mine = [one for one in scripts if "true context" in one.rows]
    if mine:
        names = ("f1", "f1_of_copy", "f1_with_true_context")
        columns = [f1(counts.sum(axis=0)) for counts in contact_counts_of(mine)]
        for row, share, *values in zip(rows, moving(mine).mean(axis=0), *columns, strict=True):
            told = dict(zip(names, map(float, values), strict=True))
            row.update({"moving": float(share)} | (told if share else {}))
    for name in _IMAGES:
        whole, both = image_figures(scripts, name)
        for row, pair in zip(rows, both.mean(axis=0) if whole else [], strict=False):
            row[name], row[f"{name}_of_warped_start"] = (float(value) for value in pair)
    sharp = [one.rows["sharpness"]["sharpness"] for one in scripts if "sharpness" in one.rows]
    if sharp:
        for row, (ours, true) in zip(rows, np.sum(sharp, axis=0).tolist(), strict=True):
            row["sharpness"] = ours / true if true else None
    return rows
