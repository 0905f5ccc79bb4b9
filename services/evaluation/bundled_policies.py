"""Built-in (bundled) policies by name: a new one is its module and a line of `BUNDLED`."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

PRETRAINED = Path(__file__).parent / "pretrained"
DEFAULT_POLICY = PRETRAINED / "behaviour_cloning.safetensors"


@dataclass(frozen=True)
class Bundled:
    """A policy by MODULE:FACTORY, called with its checkpoint if it has one.

    It is imported when it is used. Users may give another checkpoint.
    """

    factory: str
    checkpoint: Path | None = None


_POLICIES: Final = "services.evaluation.policies"
# Classes of policies that `dextouch train policy` writes, by the kind of their checkpoint. Those of
# places also need the start readers of a world model, so that they join two services.
TRAINED: Final[Mapping[str, str]] = {
    "cloned-policy": f"{_POLICIES}.behaviour_cloning:BehaviourCloningPolicy",
    "place-policy": "services.pipelines.place_policy:PlacePolicy",
}
BUNDLED: Final[Mapping[str, Bundled]] = {
    # With another checkpoint, any policy of `dextouch train policy`.
    "behaviour-cloning": Bundled(f"{__name__}:trained_policy", DEFAULT_POLICY),
    # Knows only the tasks stand_bottle and open_drawer.
    "colour-servo": Bundled(f"{_POLICIES}.colour_servo:ColourServo"),
    "hold": Bundled(f"{_POLICIES}.open_loop:HoldPolicy"),
}
if TYPE_CHECKING:
    from dextouch.clients import Policy

    BundledName = str
else:
    BundledName = Literal[tuple(BUNDLED)]


def checkpoint_of(name: str, given: Path | None = None) -> Path | None:
    """File of a bundled policy's weights: the one given, or its own; None if it has no weights."""
    return given or BUNDLED[name].checkpoint


def bundled_policy(name: str, checkpoint: Path | None = None) -> "Policy":
    """Create a bundled policy, with other weights if they are given (`load_checkpoint`)."""
    make = _imported(BUNDLED[name].factory)
    path = checkpoint_of(name, checkpoint)
    made: Policy = make() if path is None else make(path)
    return made


def trained_policy(path: Path) -> "Policy":
    """Load a policy of `dextouch train policy`, of any kind; raises as `load_checkpoint`."""
    from services.evaluation.trained_networks import load_checkpoint

    checkpoint = load_checkpoint(path, kind=tuple(TRAINED))
    made: Policy = _imported(TRAINED[checkpoint.metadata.kind])(checkpoint)
    return made


def _imported(address: str) -> Any:  # noqa: ANN401 - a class or function
    module, _, name = address.partition(":")
    return getattr(import_module(module), name)


def training_starts_of(policy: "Policy") -> tuple[str, ...]:
    """Digests of the starts that a bundled policy was trained on; none without training."""
    metadata = getattr(policy, "metadata", None)
    return () if metadata is None else tuple(metadata.training_starts)
