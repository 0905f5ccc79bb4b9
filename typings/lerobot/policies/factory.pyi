from typing import Any

from lerobot.configs.policies import PreTrainedConfig

def get_policy_class(name: str) -> Any: ...
def make_pre_post_processors(
    policy_cfg: PreTrainedConfig,
    pretrained_path: str | None = ...,
    *,
    preprocessor_overrides: dict[str, Any] = ...,
) -> tuple[Any, Any]: ...
