"""One policy in the twin and in an imagined world from the same first observation, and errors."""

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from benchmarks.evaluator.plan import NUM_STEPS, STILL_CHUNKS, STILL_SHOWN_EVERY
from dextouch.clients import Policy, PolicyStart
from dextouch.geometry import apply, invert, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.hands.actions import AnchorPoses, HandTrajectory, poses_from_actions, reanchor
from dextouch.metrics.image import PEAK, decibels
from dextouch.metrics.tactile import mse
from dextouch.schemas import (
    CHUNK_STEPS,
    Observation,
    ReturnSelector,
    RolloutStart,
    RolloutUncertainty,
    rollout_uncertainty,
)
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile import in_contact
from dextouch.worlds import StartedRollout, State, World
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.policies.user_policies import action_chunk, ask
from services.evaluation.prediction_scenes import warp_over_table
from services.twin.stage import Actions
from services.twin.world import TwinState, TwinWorld

_NO_IMAGES = ReturnSelector(cameras=())
_LAST_IMAGE = ReturnSelector(steps="last")


@dataclass(frozen=True)
class TrueRollout:
    """Rollout of a policy in the twin.

    Chunk ends are steps 16, 32 … 80. `actions` are what was sent, relative to step 0;
    `object_poses` T_world_object at step 0 and the chunk ends. `images_of_chunks` are those at the
    chunk ends, or none.
    """

    success: bool
    actions: Actions
    tactile_kpa: Float32[np.ndarray, "81 2 320"]
    images_of_chunks: UInt8[np.ndarray, "chunks h w 3"]
    last_images: UInt8[np.ndarray, "3 h w 3"]
    object_poses: Float64[np.ndarray, "ends objects 7"]


@dataclass(frozen=True)
class ImaginedRollout:
    """Imagined rollout of the same policy, with the world's uncertainty of all of it."""

    tactile_kpa: Float32[np.ndarray, "81 2 320"]
    images_of_chunks: UInt8[np.ndarray, "chunks h w 3"]
    last_images: UInt8[np.ndarray, "3 h w 3"]
    object_poses: Float32[np.ndarray, "3 objects 7"] | None
    uncertainty: RolloutUncertainty

    def ending(self, task: str) -> Ending:
        """What the judge sees of it."""
        return Ending(
            self.last_images,
            self.tactile_kpa[-NUM_SEEN_STEPS:],
            task,
            self.object_poses,
            imagined=True,
        ).with_uncertainty(self.uncertainty)


def play_in_twin(
    twin: TwinWorld,
    started: StartedRollout[TwinState],
    policy: Policy | Actions,
    start: PolicyStart,
    *,
    shows_chunks: bool = True,
) -> TrueRollout:
    """Let a policy, in closed loop or as the commands of all steps, act in the twin from its start.

    A closed-loop policy is told `start`; `shows_chunks` keeps images at the ends of chunks.
    """
    stage, state = twin.stage(start.task), started.state
    touch, sent = [started.observation.tactile_kpa], []
    poses, images = [stage_poses(twin, state)], []
    seen = started.observation
    uses_images = _begin(policy, start)
    for first in range(0, NUM_STEPS, CHUNK_STEPS):
        chunk = _chunk(policy, seen, first, twin)
        shows_end = uses_images == "last" or first + CHUNK_STEPS == NUM_STEPS
        head = CHUNK_STEPS - 4 if shows_end else CHUNK_STEPS
        # Images are slow, so only those that are used are rendered.
        selector = ReturnSelector() if uses_images == "all" else _NO_IMAGES
        step = twin.step(state, chunk[:head], seed=start.seed, selector=selector)
        parts = [step]
        if shows_end:
            parts.append(twin.step(step.state, chunk[head:], seed=start.seed))
        touch.extend(part.observation.tactile_kpa for part in parts)
        state, seen = parts[-1].state, parts[-1].observation
        if shows_chunks:
            images.append(stage.rig.image(stage.simulation, HEAD_CAMERA))
        poses.append(stage.simulation.object_poses())
        sent.append(chunk)
    return TrueRollout(
        bool(seen.success),
        np.concatenate(sent),
        np.concatenate(touch),
        _stacked(images, seen),
        seen.images[HEAD_CAMERA][-NUM_SEEN_STEPS:],
        np.stack(poses),
    )


def stage_poses(twin: TwinWorld, state: TwinState) -> Float64[np.ndarray, "objects 7"]:
    """Object poses of a state."""
    simulation = twin.stage(state.task).simulation
    simulation.set_state(state.physics, step_index=0)
    return simulation.object_poses()


def play_in_imagination(
    world: World[State],
    first: RolloutStart,
    policy: Policy | Actions,
    start: PolicyStart,
    *,
    shows_chunks: bool = True,
) -> ImaginedRollout:
    """Let a policy act in an imagined world; if it uses images, it observes imagined ones.

    Policy, start and images as in `play_in_twin`.
    """
    started = world.reset(first)
    state, seen = started.state, started.observation
    touch, images = [seen.tactile_kpa], []
    uses_images = _begin(policy, start)
    observed: list[Observation] = []
    for at in range(0, NUM_STEPS, CHUNK_STEPS):
        chunk = _chunk(policy, seen, at, world)
        if uses_images == "all" or at + CHUNK_STEPS == NUM_STEPS:
            step = last = world.step(state, chunk, seed=start.seed + at)
        else:
            # A world is functional: two calls give touch of all steps and only the last image.
            step = last = world.step(state, chunk, seed=start.seed + at, selector=_NO_IMAGES)
            if shows_chunks or uses_images == "last":
                last = world.step(state, chunk, seed=start.seed + at, selector=_LAST_IMAGE)
        if shows_chunks:
            images.append(last.observation.images[HEAD_CAMERA][-1])
        state, seen = step.state, last.observation
        touch.append(step.observation.tactile_kpa)
        observed.append(seen)
    poses = seen.object_poses
    return ImaginedRollout(
        np.concatenate(touch),
        _stacked(images, seen),
        seen.images[HEAD_CAMERA][-NUM_SEEN_STEPS:],
        None if poses is None else poses[-NUM_SEEN_STEPS:],
        rollout_uncertainty(observed),
    )


def _stacked(images: list[np.ndarray], seen: Observation) -> UInt8[np.ndarray, "chunks h w 3"]:
    return np.stack(images) if images else seen.images[HEAD_CAMERA][:0]


def _begin(policy: Policy | Actions, start: PolicyStart) -> Literal["no", "last", "all"]:
    """Reset a closed-loop policy, and return which steps of a chunk it needs images of."""
    if isinstance(policy, np.ndarray):
        return "no"
    ask(policy.reset, start, where="policy: reset")
    uses_images = getattr(policy, "uses_images", True)
    return "last" if uses_images == "last" else "all" if uses_images else "no"


def _chunk(
    policy: Policy | Actions, seen: Observation, first: int, world: World[State]
) -> Float64[np.ndarray, "16 67"]:
    if isinstance(policy, np.ndarray):
        return policy[first : first + CHUNK_STEPS]
    where = f"policy, step {first}: act"
    answer = ask(policy.act, seen, where=where)
    return action_chunk(answer, world.description, where=where)[:CHUNK_STEPS]


def start_amid(
    first: RolloutStart,
    image: UInt8[np.ndarray, "h w 3"],
    tactile_kpa: Float32[np.ndarray, "2 320"],
    reached: Float64[np.ndarray, "67"],
) -> RolloutStart:
    """A start from a later step of a rollout, with what is seen and felt at that step.

    The action that the hands have reached is relative to the start of the rollout, `first`.
    """
    if first.anchor is None:
        raise ValueError("the twin gives an anchor with every start")
    observation = Observation(
        first_step=0,
        images={HEAD_CAMERA: image[None]},
        tactile_kpa=tactile_kpa[None],
        action_reached=reanchor(reached[None], 0),
        reached_is_measured=True,
    )
    anchor = poses_from_actions(reached[None], first.anchor).anchor(0)
    return replace(first, observation=observation, anchor=anchor)


def start_in_twin(
    twin: TwinWorld, task: str, seed: int, instruction: str
) -> tuple[StartedRollout[TwinState], RolloutStart, PolicyStart]:
    """Start of a rollout in the twin, and the same start for an imagined world and a policy."""
    request = RolloutStart(task=task, seed=seed, instruction=instruction)
    started = twin.reset(request)
    imagined = replace(
        request, observation=started.observation, anchor=started.anchor, K_head=started.K_head
    )
    return started, imagined, PolicyStart(task, instruction, seed, started.anchor, started.K_head)


# Margin in pixels around an object's box that belongs to its region.
_MARGIN_PX: Final = 1
ChunkRow = dict[str, list[list[float]]]


def chunk_figures(
    real: TrueRollout,
    imagined: ImaginedRollout,
    anchor: AnchorPoses,
    K_head: np.ndarray,
    first_image: np.ndarray,
    boxes_m: np.ndarray,
) -> ChunkRow:
    """Contact counts of imagined and copied touch, and PSNR at the end of every chunk.

    Counts are taxels in contact [in both, imagined, true]. The copy is the true touch at the
    chunk's start, which the world model does not get. PSNR is [imagined, warped] for the whole
    image and for the region where objects are or were; warped is the rollout's first image,
    warped by the known motion of the camera over the table.
    """
    cameras = poses_from_actions(real.actions, anchor).Ts_world_camera_head
    found: ChunkRow = {"contact": [], "contact_of_copy": [], "psnr": [], "psnr_of_objects": []}
    for index, image in enumerate(real.images_of_chunks):
        steps = slice(1 + index * CHUNK_STEPS, 1 + (index + 1) * CHUNK_STEPS)
        truth = real.tactile_kpa[steps]
        copied = np.broadcast_to(real.tactile_kpa[steps.start - 1], truth.shape)
        found["contact"].append(contact_counts(imagined.tactile_kpa[steps], truth))
        found["contact_of_copy"].append(contact_counts(copied, truth))
        T_world_now = cameras[steps.stop - 2]
        warped = warp_over_table(first_image, K_head, anchor.T_world_camera_head, T_world_now)
        region = object_region(
            np.concatenate([real.object_poses[0], real.object_poses[index + 1]]),
            np.concatenate([boxes_m, boxes_m]),
            K_head,
            T_world_now,
            image.shape[:2],
        )
        pair = (imagined.images_of_chunks[index], warped)
        found["psnr"].append([psnr_within(one, image) for one in pair])
        if region.any():
            found["psnr_of_objects"].append([psnr_within(one, image, region) for one in pair])
    return found


def contact_counts(predicted_kpa: np.ndarray, true_kpa: np.ndarray) -> list[float]:
    """Taxels in contact: in both, predicted, true. F1 is 2·both / (predicted + true)."""
    told, came = in_contact(predicted_kpa), in_contact(true_kpa)
    return [float((told & came).sum()), float(told.sum()), float(came.sum())]


def psnr_within(
    predicted: np.ndarray, true: np.ndarray, region: np.ndarray | slice = slice(None)
) -> float:
    """PSNR in dB over the pixels of a region, or of the whole image."""
    error = predicted[region].astype(np.float64) - true[region].astype(np.float64)
    return float(decibels(np.mean(error**2), peak=PEAK))


def object_region(
    object_poses: np.ndarray,
    boxes_m: np.ndarray,
    K: np.ndarray,
    T_world_camera: np.ndarray,
    shape_px: tuple[int, int],
) -> Bool[np.ndarray, "h w"]:
    """Pixels in the rectangles around boxes [objects, 6] of objects at poses [objects, 7]."""
    region = np.zeros(shape_px, dtype=bool)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    for pose, box in zip(object_poses, boxes_m, strict=True):
        corners = apply(transform_from_pose(pose), box[:3] + signs * box[3:])
        seen = apply(invert(T_world_camera), corners)
        if (seen[:, 2] <= 0).any():
            continue
        pixels = (seen / seen[:, 2:]) @ K.T
        low = np.floor(pixels[:, :2].min(axis=0) - _MARGIN_PX).astype(int).clip(0)
        high = np.ceil(pixels[:, :2].max(axis=0) + _MARGIN_PX).astype(int).clip(0)
        region[low[1] : high[1], low[0] : high[0]] = True
    return region


def wrong_action_figures(
    real: TrueRollout, own: ImaginedRollout, wrong: ImaginedRollout
) -> dict[str, list[float] | list[list[float]]]:
    """Errors [own, wrong] of predictions for a rollout's own actions and for another's.

    Squared error of touch in kPa², mean over all steps, and PSNR at the end of every chunk.
    """
    both = (own, wrong)
    return {
        "touch_error": [mse(predicted_kpa=o.tactile_kpa, true_kpa=real.tactile_kpa) for o in both],
        "psnr": [
            [psnr_within(one.images_of_chunks[index], image) for one in both]
            for index, image in enumerate(real.images_of_chunks)
        ],
    }


def sharpness_of_chunks(real: TrueRollout, imagined: ImaginedRollout) -> list[list[float]]:
    """Mean absolute Laplacian [imagined, true] of the image at the end of every chunk."""
    pair = (imagined.images_of_chunks, real.images_of_chunks)
    return np.stack([sharpness(one.astype(np.float64)) for one in pair], axis=1).tolist()


def sharpness(images: Float64[np.ndarray, "n h w 3"]) -> Float64[np.ndarray, " n"]:
    """Mean absolute Laplacian (five points) of images, inside their border."""
    centre = images[:, 1:-1, 1:-1]
    across = images[:, 1:-1, 2:] + images[:, 1:-1, :-2]
    down = images[:, 2:, 1:-1] + images[:, :-2, 1:-1]
    return np.asarray(np.abs(across + down - 4.0 * centre).mean(axis=(1, 2, 3)))


_REACHED = ReturnSelector(cameras=(), steps="last")
# Smaller motions within a chunk count as none.
_STILL_M, _STILL_RAD = 1e-3, 0.02


def contact_with_true_context(
    twin: TwinWorld,
    world: World[State],
    started: StartedRollout[TwinState],
    first: RolloutStart,
    real: TrueRollout,
) -> list[list[float]]:
    """Contact counts of every chunk, each imagined from the true observation at its start.

    The twin replays the commands to get the true poses of hands and camera; image and touch are
    those of the kept rollout, and the commands are the same.
    """
    found = []
    reached = _reached_rows(twin, started, real)
    for index in range(len(real.images_of_chunks)):
        start, chunk = first, real.actions[index * CHUNK_STEPS : (index + 1) * CHUNK_STEPS]
        if index:
            image, touch = real.images_of_chunks[index - 1], real.tactile_kpa[index * CHUNK_STEPS]
            start = start_amid(first, image, touch, reached[index - 1])
            chunk = reanchor(chunk, 0, anchor_action=reached[index - 1])
        state = world.reset(start).state
        imagined = world.step(state, chunk, seed=first.seed, selector=_NO_IMAGES)
        after = slice(1 + index * CHUNK_STEPS, 1 + (index + 1) * CHUNK_STEPS)
        found.append(contact_counts(imagined.observation.tactile_kpa, real.tactile_kpa[after]))
    return found


def _reached_rows(
    twin: TwinWorld, started: StartedRollout[TwinState], real: TrueRollout
) -> list[Float64[np.ndarray, "67"]]:
    """Reached actions at the end of every chunk, relative to step 0."""
    rows, state = [], started.state
    for chunk in np.split(real.actions, len(real.images_of_chunks)):
        step = twin.step(state, chunk, seed=0, selector=_REACHED)
        rows.append(step.observation.action_reached[-1])
        state = step.state
    return rows


def chunks_that_move(
    commands: HandTrajectory, object_poses: Float64[np.ndarray, "ends objects 7"]
) -> Bool[np.ndarray, " chunks"]:
    """Whether a wrist, a finger or an object moves within each chunk.

    Commands are those of steps 1 … 80, poses T_world_object at step 0 and at the chunk ends.
    """
    moves = []
    for index in range(len(object_poses) - 1):
        rows = slice(index * CHUNK_STEPS, (index + 1) * CHUNK_STEPS)
        wrists = (commands.Ts_world_wrist_left[rows], commands.Ts_world_wrist_right[rows])
        fingers = (commands.joints_left_rad[rows], commands.joints_right_rad[rows])
        before, after = object_poses[index], object_poses[index + 1]
        turned = 2 * np.arccos(np.clip(np.abs(np.sum(before[:, 3:] * after[:, 3:], axis=1)), 0, 1))
        moves.append(
            any(np.ptp(T[:, :3, 3], axis=0).max() > _STILL_M for T in wrists)
            or any(rotation_angle(T[0, :3, :3].T @ T[:, :3, :3]).max() > _STILL_RAD for T in wrists)
            or any(np.ptp(angles, axis=0).max() > _STILL_RAD for angles in fingers)
            or bool(np.linalg.norm(after[:, :3] - before[:, :3], axis=1).max() > _STILL_M)
            or bool(turned.max() > _STILL_RAD)
        )
    return np.array(moves, dtype=bool)


_LAST_HEAD_IMAGE = ReturnSelector(cameras=(HEAD_CAMERA,), steps="last")


@dataclass(frozen=True)
class StillRollout:
    """Rollout of hands that hold still: the greatest pressure, and some images."""

    greatest_kpa: float
    images: UInt8[np.ndarray, "shown h w 3"]


def hold_still(
    world: World[State], first: RolloutStart, row: Float64[np.ndarray, "67"]
) -> StillRollout:
    """One command, sent 1008 times; images of every 144th step."""
    started = world.reset(first)
    state, greatest, images = started.state, 0.0, []
    chunk = np.repeat(row[None], CHUNK_STEPS, axis=0)
    for index in range(1, STILL_CHUNKS + 1):
        if index % STILL_SHOWN_EVERY == 0:
            observed = world.step(state, chunk, seed=index, selector=_LAST_HEAD_IMAGE)
            images.append(observed.observation.images[HEAD_CAMERA][-1])
        step = world.step(state, chunk, seed=index, selector=_NO_IMAGES)
        greatest = max(greatest, float(step.observation.tactile_kpa.max()))
        state = step.state
    return StillRollout(greatest, np.stack(images))


def still_figures(
    imagined: StillRollout, true_images: np.ndarray, first_image: np.ndarray
) -> dict[str, object]:
    """The greatest imagined pressure, and PSNR [imagined, copy of the first image] of each image.

    True images [shown, h, w, 3] are those of the same steps, the first image is that of step 0.
    """
    return {
        "greatest_kpa": imagined.greatest_kpa,
        "psnr": [
            [psnr_within(one, true) for one in (image, first_image)]
            for image, true in zip(imagined.images, true_images, strict=True)
        ],
    }
