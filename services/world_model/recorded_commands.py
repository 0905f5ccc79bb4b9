"""Commands that repeat a training run, as checkpoints record them."""

from collections.abc import Mapping

from services.world_model.settings import TrainSettings


def command_line(settings: TrainSettings) -> str:
    """Command that repeats a run: every setting that differs from its default.

    Stores are given by their last path component, since folders differ between machines.
    """
    given = settings.model_dump(
        mode="json",
        exclude_defaults=True,
        exclude={
            "output",
            "json_path",
            "episodes",
            "human",
            "heldout",
            "init",
            "tokenizer",
            "resume",
            "state_every_cpu_s",
            "device",
            "wan",
            "plan",
            "preset",
        },
    )
    flags = [f"--episodes={last_name(settings.episodes)}"]
    flags += [f"--human={last_name(url)}" for url in settings.human]
    if settings.heldout is not None:
        flags.append(f"--heldout={last_name(settings.heldout)}")
    if settings.init is not None:
        flags.append(f"--init={settings.init.name}")
    if settings.tokenizer is not None:
        flags.append(f"--tokenizer={settings.tokenizer.name}")
    form = f"--preset={settings.preset}"
    return " ".join(["dextouch train world-model", form, *flags, *flags_of(given)])


def flags_of(given: Mapping[str, object], prefix: str = "") -> list[str]:
    """Flags of a command for these settings; names of nested ones are joined by dots."""
    flags: list[str] = []
    for name, value in given.items():
        flag = prefix + name.replace("_", "-")
        if isinstance(value, Mapping):
            flags += flags_of(value, f"{flag}.")
        elif isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            values = value if isinstance(value, list) else [value]
            flags += [f"--{flag}={one}" for one in values]
    return flags


def last_name(url: str) -> str:
    """Last component of a path or URL."""
    return url.rstrip("/").rsplit("/", 1)[-1]
