"""Tactile tokenizer of a network configuration."""

from dextouch.errors import InvalidInputError
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.grid_tokenizer import GridTokenizer
from services.world_model.network.principal_axes_tokenizer import PrincipalAxesTokenizer
from services.world_model.network.split_hands import SplitHandsTokenizer
from services.world_model.network.tactile_tokenizer import TactileTokenizer


def build_tokenizer(config: NetworkConfig) -> TactileTokenizer:
    """The tokenizer that the configuration names, with initial weights.

    Raises:
        InvalidInputError: tokens per pad with another tokenizer than Split-Hands.
    """
    if config.tactile_tokens == "pad" and config.tokenizer != "split_hands":
        raise InvalidInputError(
            f"network: got tactile_tokens pad with tokenizer {config.tokenizer}, expected hand; "
            "only split_hands has a token for each pad"
        )
    if config.tokenizer == "split_hands":
        return SplitHandsTokenizer(config)
    if config.tokenizer == "grid":
        return GridTokenizer(config)
    return PrincipalAxesTokenizer(config)
