"""Checkpoints that ship with the package; imports no torch, so that settings can name them."""

from pathlib import Path

PRETRAINED = Path(__file__).parent / "pretrained"
STATE_MODEL, PAPER_FORM = "state.safetensors", "tiny.safetensors"


def default_checkpoint() -> Path:
    """Default checkpoint of the package: the state model if it is installed."""
    state = PRETRAINED / STATE_MODEL
    return state if state.is_file() else paper_form_checkpoint()


def paper_form_checkpoint() -> Path:
    """Checkpoint of the joint flow-matching model that ships with the package."""
    return PRETRAINED / PAPER_FORM
