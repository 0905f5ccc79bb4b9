from typing import Any

class PreTrainedConfig:
    type: str
    device: str | None
    use_amp: bool
    input_features: dict[str, Any]
    output_features: dict[str, Any]
    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str) -> PreTrainedConfig: ...
