from typing import Any

import numpy as np

def predict_action(
    observation: dict[str, np.ndarray],
    policy: Any,
    device: Any,
    preprocessor: Any,
    postprocessor: Any,
    use_amp: bool,
    task: str | None = ...,
) -> Any: ...
