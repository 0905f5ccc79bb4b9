"""Recorded futures that predictions of a world are compared with, their geometry, and baselines."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from dextouch.episodes import EpisodeGrid, EpisodeReader
from dextouch.errors import InvalidInputError
from dextouch.geometry import apply, invert
from dextouch.hands.actions import CAMERA_HEAD, poses_from_actions
from dextouch.metrics import image as depth_metrics
from dextouch.metrics import trajectory as trajectory_metrics
from dextouch.schemas import CHUNK_STEPS, Observation, ReturnSelector, RolloutStart
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from dextouch.worlds import ReconstructingWorld, World

# Labels of what a pixel shows; hands and objects follow the table.
BACKGROUND, TABLE, FIRST_BODY = 0, 1, 2
# Depth of a pixel that shows nothing (m): the farthest that the twin renders.
FAR_M: Final = 4.0
# Shading of a colour that is lit: ambient light alone … full light.
BRIGHTNESS: Final = (0.3, 1.0)
# A body of fewer pixels has no position.
MIN_PIXELS: Final = 3
# Mean distance at which the accuracy of a trajectory falls to 1/e, as a share of the image's width.
TOLERANCE: Final = 0.05
# A body that moves less than this over a scene has no trajectory to compare.
MIN_PATH_PX: Final = 2.0
# World models may begin from these, too.
_WRISTS: Final = ("camera_wrist_left", "camera_wrist_right")
_NO_IMAGE = ReturnSelector(cameras=())
_LAST_STEP = ReturnSelector(cameras=(HEAD_CAMERA,), steps="last")


@dataclass(frozen=True)
class SceneGeometry:
    """Exact geometry of a scene's true images.

    Labels are 0 for the background, 1 for the table, then bodies: hands and objects. `colours` has
    rows of label, red, green and blue (0 … 1); `table_m` is the depth of the bare table.
    """

    colours: Float64[np.ndarray, "colours 4"]
    labels: Int64[np.ndarray, "shown h w"]
    depth_m: Float64[np.ndarray, "shown h w"]
    table_m: Float64[np.ndarray, "shown h w"]


def labelled(
    images: UInt8[np.ndarray, "shown h w 3"], colours: Float64[np.ndarray, "colours 4"]
) -> Int64[np.ndarray, "shown h w"]:
    """Label of the colour nearest to each pixel, each colour at the brightness that fits best."""
    pixels = images.reshape(-1, 3).astype(np.float64) / 255.0
    rgb = colours[:, 1:]
    scale = (pixels @ rgb.T) / np.maximum((rgb**2).sum(axis=1), 1e-9)
    lit = np.where(colours[:, 0] == BACKGROUND, 1.0, np.clip(scale, *BRIGHTNESS))
    # |p - b c|² = p·p - 2 b p·c + b² c·c; p·p is the same for all colours.
    distance = lit * (lit * (rgb**2).sum(axis=1) - 2.0 * (pixels @ rgb.T))
    return colours[distance.argmin(axis=1), 0].astype(np.int64).reshape(images.shape[:-1])


def centroids(labels: Int64[np.ndarray, "shown h w"], label: int) -> Float64[np.ndarray, "shown 2"]:
    """Mean pixel (u, v) of a label in each image, NaN where it has fewer than three pixels."""
    found = np.full((len(labels), 2), np.nan)
    for index, image in enumerate(labels):
        v, u = np.nonzero(image == label)
        if len(u) >= MIN_PIXELS:
            found[index] = u.mean(), v.mean()
    return found


def trajectory_accuracies(
    geometry: SceneGeometry, images: UInt8[np.ndarray, "shown h w 3"]
) -> list[float]:
    """Accuracy of the trajectory of every body that moves by at least two pixels."""
    seen = labelled(images, geometry.colours)
    found = []
    for label in range(FIRST_BODY, int(geometry.colours[:, 0].max()) + 1):
        true = centroids(geometry.labels, label)
        shown = np.isfinite(true).all(axis=1)
        true = true[shown]
        if len(true) < 2 or np.linalg.norm(np.diff(true, axis=0), axis=1).sum() < MIN_PATH_PX:
            continue
        predicted = centroids(seen, label)[shown]
        tolerance = TOLERANCE * images.shape[2]
        found.append(
            trajectory_metrics.trajectory_accuracy(
                predicted=predicted, true=true, tolerance=tolerance
            )
        )
    return found


def implied_depth(
    geometry: SceneGeometry, images: UInt8[np.ndarray, "shown h w 3"]
) -> Float64[np.ndarray, "shown h w"]:
    """Depth of what each pixel shows: the table's, or the mean depth of that body.

    The mean is of the body's true pixels in the same image, or in all of the scene's if it is
    hidden in that one; a body that is never visible counts as the table.
    """
    seen = labelled(images, geometry.colours)
    depth_m = np.where(seen == BACKGROUND, FAR_M, geometry.table_m)
    for label in range(FIRST_BODY, int(geometry.colours[:, 0].max()) + 1):
        everywhere = geometry.labels == label
        if not everywhere.any():
            continue
        mean_m = geometry.depth_m[everywhere].mean()
        for index in range(len(seen)):
            here = everywhere[index]
            value_m = geometry.depth_m[index][here].mean() if here.any() else mean_m
            depth_m[index][seen[index] == label] = value_m
    return depth_m


def depth_errors(geometry: SceneGeometry, images: UInt8[np.ndarray, "shown h w 3"]) -> list[float]:
    """AbsRel of the implied depth where the truth shows something, of the whole scene."""
    implied_m = implied_depth(geometry, images)
    return [depth_metrics.depth_error(predicted_m=implied_m, true_m=geometry.depth_m)]


@dataclass(frozen=True)
class Future:
    """Touch of every step after the first, and the images of some of them.

    Steps are counted from 1, the one after the first observation; `image_steps` are those of the
    images. `objects_m` are the positions of the task's objects at the last step in the world, NaN
    where they are not known, and None of what says nothing of objects. `measured_taxels` are those
    whose pressure was measured; None: all.
    """

    images: UInt8[np.ndarray, "shown h w 3"]
    tactile_kpa: Float32[np.ndarray, "steps 2 taxels"]
    image_steps: tuple[int, ...]
    objects_m: Float64[np.ndarray, "objects 3"] | None = None
    measured_taxels: Bool[np.ndarray, "steps 2 taxels"] | None = None

    def is_measured(self) -> Bool[np.ndarray, "steps 2 taxels"]:
        """Taxels at steps whose pressure is known."""
        if self.measured_taxels is None:
            return np.ones(self.tactile_kpa.shape, dtype=np.bool_)
        return self.measured_taxels


@dataclass(frozen=True)
class Scene:
    """Start at a step of an episode, its actions from there, and the true future.

    `geometry` is that of the true images, if it is known, and `first_objects_m` are the positions
    of the objects at the start, as in `Future`. `layout` is that of the taxels.
    """

    episode_id: str
    start: RolloutStart
    actions: Float64[np.ndarray, "steps 67"]
    truth: Future
    model_rate_hz: float
    first_step: int = 0
    geometry: SceneGeometry | None = None
    first_objects_m: Float64[np.ndarray, "objects 3"] | None = None
    layout: TactileLayout = DEXTOUCH_V1

    @property
    def first(self) -> Observation:
        """The observed first step."""
        if self.start.observation is None:
            raise InvalidInputError(f"scene {self.episode_id!r}: begins without an observation")
        return self.start.observation

    @property
    def first_image(self) -> UInt8[np.ndarray, "1 h w 3"]:
        """The observed first image of the head camera."""
        return self.first.images[HEAD_CAMERA]


def read_rollout(reader: EpisodeReader) -> Scene:
    """A whole episode as one scene, up to its last complete chunk.

    Raises InvalidInputError if it is shorter than one, UnknownNameError without head camera.
    """
    num_steps = (reader.num_steps - 1) // CHUNK_STEPS * CHUNK_STEPS
    if num_steps == 0:
        raise InvalidInputError(
            f"prediction: episode {reader.attributes.episode_id!r} has {reader.num_steps} steps, "
            f"expected at least {CHUNK_STEPS + 1}"
        )
    return _read(EpisodeGrid(reader), 0, num_steps, image_every=CHUNK_STEPS)


def read_windows(reader: EpisodeReader) -> list[Scene]:
    """An episode as consecutive scenes of one chunk, each from the true step before it.

    Chunks with interpolated actions are left out, and those without an image before or of them.
    """
    grid = EpisodeGrid(reader)
    shown = np.isin(np.arange(len(grid)), grid.image_steps)
    starts = range(0, len(grid) - CHUNK_STEPS, CHUNK_STEPS)
    return [
        _read(grid, start, CHUNK_STEPS, image_every=1)
        for start in starts
        if grid.is_measured(start, start + CHUNK_STEPS + 1)
        and shown[start]
        and shown[start + 1 : start + CHUNK_STEPS + 1].any()
    ]


def _read(grid: EpisodeGrid, first_step: int, num_steps: int, *, image_every: int) -> Scene:
    about, reader, kind = grid.about, grid.reader, grid.action_kind
    own = {int(step) - first_step for step in grid.image_steps}
    shown = tuple(step for step in range(1, num_steps + 1) if step % image_every == 0)
    shown = tuple(step for step in shown if step in own)
    if 0 not in own or not shown:
        raise InvalidInputError(
            f"prediction: episode {about.episode_id!r} has no image of step {first_step} or of "
            f"those predicted from it; record it with images (`dextouch train data --images 1`)"
        )
    start = RolloutStart(
        about.task,
        about.seed or 0,
        about.instruction,
        kind,
        observation=grid.observation(first_step, _WRISTS),
        anchor=reader.anchor(first_step),
        K_head=grid.K_head,
    )
    touch_kpa, is_sampled = reader.touch(first_step + 1, num_steps)
    truth = Future(
        grid.images([first_step + step for step in shown]),
        touch_kpa,
        shown,
        _objects_m(grid, first_step + num_steps),
        is_sampled[..., None] & grid.measured_taxels,
    )
    actions = reader.actions(first_step, num_steps + 1, kind=kind)[1:]
    return Scene(
        about.episode_id,
        start,
        actions,
        truth,
        about.model_rate_hz,
        first_step,
        first_objects_m=_objects_m(grid, first_step),
        layout=grid.tactile_layout,
    )


def _objects_m(grid: EpisodeGrid, step: int) -> Float64[np.ndarray, "objects 3"] | None:
    """Positions of an episode's objects at a step, NaN where unknown; None without any."""
    track = grid.objects
    if track is None:
        return None
    positions_m = track.poses[step, :, :3].astype(np.float64)
    return np.where(track.known[step, :, None], positions_m, np.nan)


def imagine(world: World[Any], scene: Scene, actions: Float64[np.ndarray, "steps 67"]) -> Future:
    """Prediction of a scene's future for given actions, with images of the steps of its truth."""
    state = world.reset(scene.start).state
    images, touch, objects_m = [], [], None
    for first in range(0, len(actions), CHUNK_STEPS):
        chunk, seed = actions[first : first + CHUNK_STEPS], scene.start.seed + first
        shown = [s - first - 1 for s in scene.truth.image_steps if first < s <= first + len(chunk)]
        # Only what is compared is rendered; a world is functional, so one state serves two calls.
        selector = (
            _NO_IMAGE if shown in ([], [len(chunk) - 1]) else ReturnSelector(cameras=(HEAD_CAMERA,))
        )
        felt = world.step(state, chunk, seed=seed, selector=selector)
        if selector is not _NO_IMAGE:
            images.append(felt.observation.images[HEAD_CAMERA][shown])
        elif shown:
            last = world.step(state, chunk, seed=seed, selector=_LAST_STEP)
            images.append(last.observation.images[HEAD_CAMERA])
        touch.append(felt.observation.tactile_kpa)
        poses = felt.observation.object_poses
        objects_m = None if poses is None else poses[-1, :, :3].astype(np.float64)
        state = felt.state
    shown_steps = scene.truth.image_steps
    return Future(np.concatenate(images), np.concatenate(touch), shown_steps, objects_m)


def other_take(scene: Scene, scenes: Sequence[Scene]) -> Scene | None:
    """The next scene of another episode of the task, at the same step and as long.

    One with another seed is preferred, whose objects lie elsewhere. Recorded episodes have no seed.
    """
    key = (scene.start.task, scene.first_step)
    mine = [one for one in scenes if (one.start.task, one.first_step) == key]
    at = next(index for index, one in enumerate(mine) if one is scene)
    others = [
        one
        for one in mine[at + 1 :] + mine[:at]
        if one.episode_id != scene.episode_id and len(one.actions) >= len(scene.actions)
    ]
    elsewhere = (one for one in others if one.start.seed != scene.start.seed)
    return next(elsewhere, others[0] if others else None)


def other_instruction(scene: Scene, scenes: Sequence[Scene]) -> str | None:
    """Instruction of the task after the scene's, in alphabetical order; None if it is alone."""
    of_task = {one.start.task: one.start.instruction for one in scenes}
    tasks = sorted(of_task)
    others = tasks[tasks.index(scene.start.task) + 1 :] + tasks[: tasks.index(scene.start.task)]
    sentences = [of_task[task] for task in others if of_task[task] != scene.start.instruction]
    return sentences[0] if sentences else None


def standing_still(scene: Scene, *, head_moves: bool) -> Float64[np.ndarray, "steps 67"]:
    """The scene's actions with the first one repeated, optionally except for the head."""
    rows = np.repeat(scene.actions[:1], len(scene.actions), axis=0)
    if head_moves:
        rows[:, CAMERA_HEAD] = scene.actions[:, CAMERA_HEAD]
    return rows


def copied(scene: Scene) -> Future:
    """The first step, repeated."""
    first, truth = scene.first, scene.truth
    return Future(
        np.repeat(first.images[HEAD_CAMERA], len(truth.images), axis=0),
        np.repeat(first.tactile_kpa, len(truth.tactile_kpa), axis=0),
        truth.image_steps,
        scene.first_objects_m,
    )


def warped(scene: Scene) -> UInt8[np.ndarray, "shown h w 3"]:
    """The first image, warped by the known motion of the camera as if it showed only the table."""
    anchor, K_head = scene.start.anchor, scene.start.K_head
    if anchor is None or K_head is None:
        raise InvalidInputError(f"scene {scene.episode_id!r}: begins without camera")
    cameras = poses_from_actions(scene.actions, anchor).Ts_world_camera_head
    image, T_world_then = scene.first.images[HEAD_CAMERA][0], anchor.T_world_camera_head
    return np.stack(
        [
            warp_over_table(image, K_head, T_world_then, cameras[step - 1])
            for step in scene.truth.image_steps
        ]
    )


def reconstructed(world: World[Any], scene: Scene) -> Future | str:
    """The true future through the world's codecs, the best that it can predict, or why it has none.

    It needs codecs, and images of all steps.
    """
    truth = scene.truth
    if not isinstance(world, ReconstructingWorld):
        return "the world has no codecs"
    if truth.image_steps != tuple(range(1, len(truth.tactile_kpa) + 1)):
        return "it needs images of all steps"
    images = np.concatenate([scene.first.images[HEAD_CAMERA], truth.images])
    touch = np.concatenate([scene.first.tactile_kpa, truth.tactile_kpa])
    seen, felt = world.reconstruct(images, touch)
    return Future(seen, felt, truth.image_steps)


def warp_over_table(
    image: UInt8[np.ndarray, "h w 3"],
    K: np.ndarray,
    T_world_then: np.ndarray,
    T_world_now: np.ndarray,
) -> UInt8[np.ndarray, "h w 3"]:
    """Image of a camera now if everything in its earlier image lies on the table plane z = 0.

    Bilinear; pixels outside the image repeat its edge. Rays that miss the table count as
    infinitely far.
    """
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(K).T @ T_world_now[:3, :3].T
    down = rays[:, 2] < -1e-9
    far = np.where(down, -T_world_now[2, 3] / np.where(down, rays[:, 2], 1.0), 1e6)
    points = T_world_now[:3, 3] + far[:, None] * rays
    then = apply(invert(T_world_then), points)
    depth = np.where(np.abs(then[:, 2:]) > 1e-9, then[:, 2:], 1e-9)
    at = (then / depth) @ K.T - 0.5
    return _bilinear(image, at[:, :2]).reshape(height, width, 3)


def _bilinear(image: np.ndarray, at_px: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    height, width = image.shape[:2]
    x = np.clip(at_px[:, 0], 0, width - 1)
    y = np.clip(at_px[:, 1], 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    values: Float64[np.ndarray, "n 3"] = (
        image[top, left] * (1 - fx) * (1 - fy)
        + image[top, right] * fx * (1 - fy)
        + image[bottom, left] * (1 - fx) * fy
        + image[bottom, right] * fx * fy
    )
    return np.round(values).astype(np.uint8)
