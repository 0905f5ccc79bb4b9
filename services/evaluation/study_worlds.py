"""Worlds of one evaluation: their addresses, and checks that they are compatible."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dextouch.clients import RolloutClient
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.schemas import WorldDescription
from dextouch.streams import HEAD_CAMERA
from services.evaluation.scores import REAL


@dataclass(frozen=True)
class WorldAddress:
    """Service of a world, and the world's name there."""

    client: RolloutClient
    world: str


@dataclass(frozen=True)
class StudyWorlds:
    """The real world, as `real`, and the imagined worlds by their names in the report."""

    addresses: Mapping[str, WorldAddress]
    descriptions: Mapping[str, WorldDescription]

    @classmethod
    def ask(cls, real: WorldAddress, imagined: Mapping[str, WorldAddress]) -> "StudyWorlds":
        """Request the description of every world from its service.

        Raises:
            UnavailableError: a service does not answer.
            UnknownNameError: a service has no world of this name.
            InvalidInputError: an imagined world has the name of the real one.
        """
        if REAL in imagined:
            raise InvalidInputError(
                f"imagined world {REAL!r}: this names the real world; choose another name"
            )
        addresses = {REAL: real, **imagined}
        described = {name: _description(address) for name, address in addresses.items()}
        return cls(addresses, described)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that all worlds have and policies can see."""
        first, *others = self.descriptions.values()
        return tuple(
            camera for camera in first.cameras if all(camera in one.cameras for one in others)
        )

    @property
    def digests(self) -> dict[str, str]:
        """Digest of every world, by name."""
        return {f"world {name}": one.digest for name, one in self.descriptions.items()}

    def check(self, tasks: Sequence[str], num_steps: int, image_size_px: int) -> None:
        """Reject incompatible worlds before the first rollout.

        Raises:
            UnknownNameError: a task that a world does not have.
            InvalidInputError: a real world that does not report success or does not start from
                task and seed, an imagined one that does not start from its observations, images
                of another size than the success classifier's, or a length that is not a multiple of
                a world's chunk.
        """
        real = self.descriptions[REAL]
        if not real.knows_success or "task_seed" not in real.starts_from:
            raise InvalidInputError(
                f"real world {real.name!r}: does not report success or does not start from a "
                "task and seed; expected a world that does both, such as the twin"
            )
        if HEAD_CAMERA not in real.cameras:
            raise UnknownNameError("camera of the real world", HEAD_CAMERA, list(real.cameras))
        for name, world in self.descriptions.items():
            for task in tasks:
                if task not in world.tasks:
                    raise UnknownNameError(f"task of world {name!r}", task, list(world.tasks))
            if num_steps < 1 or num_steps % world.chunk_multiple:
                raise InvalidInputError(
                    f"num_steps: got {num_steps}, expected a multiple of {world.chunk_multiple}, "
                    f"the chunk of world {name!r}"
                )
            size = (world.image_height_px, world.image_width_px)
            if size != (image_size_px, image_size_px):
                raise InvalidInputError(
                    f"world {name!r}: got images of {size[0]}x{size[1]} px, expected "
                    f"{image_size_px}x{image_size_px} px as the success classifier was trained on"
                )
            if name != REAL:
                _check_imagined(name, world, real)


def _check_imagined(name: str, world: WorldDescription, real: WorldDescription) -> None:
    if "observation" not in world.starts_from:
        raise InvalidInputError(
            f"imagined world {name!r}: starts from {', '.join(world.starts_from)}; expected one "
            "that starts from an observation of the real world"
        )
    missing = [camera for camera in world.cameras if camera not in real.cameras]
    if missing or HEAD_CAMERA not in world.cameras:
        raise InvalidInputError(
            f"imagined world {name!r}: got cameras {', '.join(world.cameras)}, expected "
            f"{HEAD_CAMERA} and only cameras of the real world ({', '.join(real.cameras)}), which "
            "provides its first images"
        )
    if world.model_rate_hz != real.model_rate_hz:
        raise InvalidInputError(
            f"imagined world {name!r}: got steps at {world.model_rate_hz:g} Hz, expected "
            f"{real.model_rate_hz:g} Hz as in the real world"
        )


def _description(address: WorldAddress) -> WorldDescription:
    described = {world.name: world for world in address.client.worlds()}
    if address.world not in described:
        raise UnknownNameError("world", address.world, list(described))
    return described[address.world]
