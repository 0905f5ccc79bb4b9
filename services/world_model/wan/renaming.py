"""Tensor names of the Wan2.2 networks in their original files and in diffusers, mapped both ways.

A rule is a pair of names, original and diffusers; `#` stands for a number and `*` for the last
part of a name. Every tensor has exactly one rule, so that the same table works both ways.
"""

import re
from collections.abc import Iterable
from typing import Literal

from dextouch.errors import InvalidInputError

Rules = tuple[tuple[str, str], ...]
Layout = Literal["original", "diffusers"]

_ATTENTIONS: Rules = (("self_attn", "attn1"), ("cross_attn", "attn2"))
_PROJECTIONS: Rules = (
    ("q", "to_q"),
    ("k", "to_k"),
    ("v", "to_v"),
    ("o", "to_out.0"),
    ("norm_q", "norm_q"),
    ("norm_k", "norm_k"),
)
TRANSFORMER_RULES: Rules = (
    ("patch_embedding.*", "patch_embedding.*"),
    ("time_embedding.0.*", "condition_embedder.time_embedder.linear_1.*"),
    ("time_embedding.2.*", "condition_embedder.time_embedder.linear_2.*"),
    ("time_projection.1.*", "condition_embedder.time_proj.*"),
    ("text_embedding.0.*", "condition_embedder.text_embedder.linear_1.*"),
    ("text_embedding.2.*", "condition_embedder.text_embedder.linear_2.*"),
    ("head.head.*", "proj_out.*"),
    ("head.modulation", "scale_shift_table"),
    ("blocks.#.modulation", "blocks.#.scale_shift_table"),
    # The only norm with weights stands second in a block; diffusers counts in that order.
    ("blocks.#.norm3.*", "blocks.#.norm2.*"),
    ("blocks.#.ffn.0.*", "blocks.#.ffn.net.0.proj.*"),
    ("blocks.#.ffn.2.*", "blocks.#.ffn.net.2.*"),
    *(
        (f"blocks.#.{theirs}.{part}.*", f"blocks.#.{ours}.{renamed_part}.*")
        for theirs, ours in _ATTENTIONS
        for part, renamed_part in _PROJECTIONS
    ),
)

_RESIDUAL: Rules = (
    ("residual.0.*", "norm1.*"),
    ("residual.2.*", "conv1.*"),
    ("residual.3.*", "norm2.*"),
    ("residual.6.*", "conv2.*"),
)


def autoencoder_rules(num_blocks: int) -> Rules:
    """Rules of the video autoencoder of Wan2.2 with this many residual blocks per resolution."""
    return (
        ("conv1.*", "quant_conv.*"),
        ("conv2.*", "post_quant_conv.*"),
        *_coder_rules("encoder", ("downsamples", "down_blocks", "downsampler"), num_blocks),
        *_coder_rules("decoder", ("upsamples", "up_blocks", "upsampler"), num_blocks + 1),
    )


def _coder_rules(coder: str, names: tuple[str, str, str], num_blocks: int) -> Rules:
    """Rules of the encoder or the decoder; the resampling follows the blocks of a resolution."""
    theirs, ours, resampler = names
    places = [
        (f"{theirs}.#.{theirs}.{index}", f"{ours}.#.resnets.{index}") for index in range(num_blocks)
    ]
    middle = [("middle.0", "mid_block.resnets.0"), ("middle.2", "mid_block.resnets.1")]
    parts = [
        ("conv1.*", "conv_in.*"),
        ("head.0.*", "norm_out.*"),
        ("head.2.*", "conv_out.*"),
        *((f"middle.1.{one}.*", f"mid_block.attentions.0.{one}.*") for one in ("norm", "to_qkv")),
        ("middle.1.proj.*", "mid_block.attentions.0.proj.*"),
        *(
            (f"{there}.{old}", f"{here}.{new}")
            for there, here in (*places, *middle)
            for old, new in _RESIDUAL
        ),
        *((f"{there}.shortcut.*", f"{here}.conv_shortcut.*") for there, here in places),
        *(
            (f"{theirs}.#.{theirs}.{num_blocks}.{one}.*", f"{ours}.#.{resampler}.{one}.*")
            for one in ("resample.1", "time_conv")
        ),
    ]
    return tuple((f"{coder}.{old}", f"{coder}.{new}") for old, new in parts)


def renamed(names: Iterable[str], rules: Rules, *, to: Layout) -> dict[str, str]:
    """Names of the other layout, by the given names.

    Raises:
        InvalidInputError: a name without a rule.
    """
    source, target = (0, 1) if to == "diffusers" else (1, 0)
    compiled = [(_pattern(rule[source]), _template(rule[target])) for rule in rules]
    found: dict[str, str] = {}
    for name in names:
        matches = ((pattern.fullmatch(name), template) for pattern, template in compiled)
        match, template = next(((m, t) for m, t in matches if m is not None), (None, ""))
        if match is None:
            raise InvalidInputError(
                f"tensor {name!r}: has no name in the {to} layout; expected the tensors of "
                "Wan2.2-TI2V-5B"
            )
        found[name] = match.expand(template)
    return found


def _pattern(rule: str) -> re.Pattern[str]:
    return re.compile(re.escape(rule).replace(r"\#", r"(\d+)").replace(r"\*", r"([a-z]+)"))


def _template(rule: str) -> str:
    """Replacement whose groups are numbered in the order of the wildcards."""
    parts = re.split(r"[#*]", rule)
    groups = [f"\\g<{number}>" for number in range(1, len(parts))]
    return "".join(part + group for part, group in zip(parts, [*groups, ""], strict=True))
