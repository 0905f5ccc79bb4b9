"""Where a camera sits on its tracker, from photos of a fixed board and the tracker's poses."""

import argparse
import csv
import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.clients import HttpLink
from dextouch.episodes import disk_errors, replace_file
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.geometry import invert, pose_from_transform
from dextouch.geometry.rotations import rotation_angle
from dextouch.serving import MSGPACK
from dextouch.streams import unpack
from services.alignment.calibration.hand_eye import (
    BoardViews,
    MountProgress,
    camera_turns,
    mount_progress,
    solve_hand_eye,
)
from services.alignment.station_calibration.boards import (
    BoardView,
    Lens,
    board_pose,
    check_unambiguous,
    decode_photo,
    find_board,
    parse_board,
    read_photos,
)
from services.alignment.station_calibration.camera_views import (
    LIVE_PERIOD_S,
    MAX_MOTION_PX,
    image_late_s,
    live_image,
    motion_px,
    read_lens,
    turns_picture,
    wait_for_camera,
)
from services.alignment.station_calibration.record import (
    TRACKERS,
    PhotoPose,
    Say,
    poses_of_photos,
    read_pairs,
    write_picture,
    write_pose,
)

POSES_HELP = (
    "CSV with the columns image,x_m,y_m,z_m,qw,qx,qy,qz (T_world_tracker), or without photos "
    "JSON: [[T_world_tracker, T_camera_board], …], each 4x4"
)

POSES_FILE: Final = "poses.csv"
BOARD_FILE: Final = "board.txt"
# Between two live images; with a path delay of 50 ms of the camera a quarter of it is an error,
# which is that of a good tracker (chosen: what a head that is held still does not exceed).
MAX_SWAY_RAD, MAX_SWAY_M = float(np.deg2rad(0.3)), 2e-3
# A place is kept by itself where the camera turned or moved so far from all kept ones (chosen).
MIN_NEW_TURN_RAD, MIN_NEW_SHIFT_M = float(np.deg2rad(8.0)), 0.05
# Half the distance of two live images, at both of which the camera has to be still.
MAX_LATE_S: Final = LIVE_PERIOD_S / 2
# Chosen: twice what a tracker with twice the expected noise needs.
MAX_PLACES: Final = 60
MAX_POSES_BYTES: Final = 1_000_000


@dataclass(frozen=True)
class PosedViews:
    """Paired poses of tracker and board, names and corners of views; `blurred` are left out."""

    names: tuple[str, ...]
    Ts_world_tracker: Float64[np.ndarray, "n 4 4"]
    Ts_camera_board: Float64[np.ndarray, "n 4 4"]
    corners: BoardViews | None = None
    blurred: tuple[str, ...] = ()

    @staticmethod
    def of(views: Sequence[BoardView], Ts_world_tracker: np.ndarray, lens: Lens) -> "PosedViews":
        """Sharp views of a board with the tracker's pose [4, 4] at each."""
        return PosedViews(
            tuple(view.name for view in views),
            np.reshape(Ts_world_tracker, (-1, 4, 4)),
            np.reshape([board_pose(view, lens) for view in views], (-1, 4, 4)),
            BoardViews(
                [view.points_board.astype(np.float64) for view in views],
                [view.pixels.astype(np.float64) for view in views],
                lens.K,
                lens.distortion,
            )
            if views
            else None,
        )

    def progress(self) -> MountProgress:
        """What these views say of the mount, and what is missing."""
        return mount_progress(self.Ts_world_tracker, self.Ts_camera_board, views=self.corners)


def calibrate_mount(options: argparse.Namespace, *, say: Say = print) -> dict[str, object]:
    """Calibrate the mount of one camera on its tracker.

    Raises DegenerateMotionError: the tracker turned too little; InvalidInputError: contradictions.
    """
    views = _read_views(options, say)
    trackers, boards = views.Ts_world_tracker, views.Ts_camera_board
    turns_rad, progress = camera_turns(boards), views.progress()
    picture = f"hand_eye_{options.camera}.svg"
    # Drawn before solving, so that it is available after a refusal.
    svg = turns_picture(turns_rad, progress.todo, views.names, None)
    path = write_picture(options.to, picture, svg)
    say(f"{len(views.names)} views of {progress.num_places} places; turns of the camera: {path}")
    for gauge in progress.gauges:
        say(f"  {gauge.title}: {gauge.value}, wanted {gauge.wanted}")
    for words in progress.todo:
        say(f"next: {words}")
    facts: dict[str, object] = {
        "num_views": len(views.names),
        "num_places": progress.num_places,
        "next": list(progress.todo),
    }
    if options.check:
        return facts
    result = progress.result or solve_hand_eye(trackers, boards, views=views.corners)
    X = result.T_tracker_camera
    # How far each view puts the board from its mean.
    places_m = (trackers @ X @ boards)[:, :3, 3]
    off_mm = np.linalg.norm(places_m - places_m.mean(axis=0), axis=1) * 1e3
    left_out = [views.names[index] for index in result.left_out_views]
    for view in left_out:
        say(f"  {view} is far off: left out; did the tracker stand still, and is it its pose?")
    write_picture(options.to, picture, turns_picture(turns_rad, progress.todo, views.names, off_mm))
    rms_mm = float(np.sqrt(np.mean(np.delete(off_mm, result.left_out_views) ** 2)))
    facts |= {
        "camera": options.camera,
        "board_scatter_rms_mm": rms_mm,
        "left_out": left_out,
        "blurred": list(views.blurred),
        "translation_mm": (X[:3, 3] * 1e3).tolist(),
        "board_scale": result.board_scale,
        "sigma_board_scale": result.sigma_board_scale,
    }
    sigma = (result.sigma_rotation_rad, result.sigma_translation_m)
    name = f"T_tracker_{TRACKERS[options.camera]}_camera_{options.camera}"
    known = write_pose(options.to, name, X, sigma, facts)
    say(
        f"{known}; the board scatters by {rms_mm:.1f} mm RMS, and is {result.board_scale:.4f} ± "
        f"{result.sigma_board_scale:.4f} times as large as entered"
    )
    return facts


def _read_views(options: argparse.Namespace, say: Say) -> PosedViews:
    if options.poses.suffix.lower() == ".json":
        trackers, boards = np.swapaxes(read_pairs(options.poses, POSES_HELP), 0, 1)
        names = tuple(f"view {index}" for index in range(len(trackers)))
        views = PosedViews(names, trackers, invert(boards) if options.invert == "board" else boards)
    else:
        views = _with_photos(poses_of_photos(options.poses, POSES_HELP), options, say)
        if options.invert == "board":
            raise InvalidInputError(
                "--invert board: the board's poses come from photos and are right"
            )
    if len(views.names) < 2:
        raise InvalidInputError(f"hand-eye: got {len(views.names)} views, expected at least 4")
    if options.invert == "tracker":
        views = replace(views, Ts_world_tracker=invert(views.Ts_world_tracker))
    return views


def _with_photos(
    poses: Mapping[str, np.ndarray], options: argparse.Namespace, say: Say
) -> PosedViews:
    if options.photos is None or options.board is None:
        raise InvalidInputError(
            f"{options.poses}: names photos, so --photos FOLDER and --board are needed too"
        )
    board = parse_board(options.board)
    check_unambiguous(board, options.board)
    paths = [options.photos / name for name in sorted(poses)]
    absent = [path.name for path in paths if not path.is_file()]
    if absent:
        raise NotFoundError(f"{options.photos}: has no photo {', '.join(absent[:5])}")
    lens, calibrated_px = read_lens(options.intrinsics or options.to, options.camera)
    photos = read_photos(paths, board)
    photos.tell_left_out(say)
    if calibrated_px != photos.size_px:
        raise InvalidInputError(
            f"photos: got {photos.size_px[0]} by {photos.size_px[1]} px, but K was measured at "
            f"{calibrated_px[0]} by {calibrated_px[1]}; take the photos in the same mode of the "
            "camera"
        )
    if not photos.views:
        raise InvalidInputError(
            f"{options.photos}: none of {len(paths)} photos shows the board sharply "
            f"({len(photos.blurred)} are blurred)"
        )
    trackers = np.stack([poses[view.name] for view in photos.views])
    return replace(PosedViews.of(photos.views, trackers, lens), blurred=photos.blurred)


class Sighting(NamedTuple):
    """A live image (JPEG; empty if there is none) and, if seen, the tracker's pose around it.

    `late_s` is how much later than at best the later one of image and pose arrived.
    """

    image: bytes
    T_before: np.ndarray | None
    T_after: np.ndarray | None
    late_s: float = 0.0


def station_sightings(
    link: HttpLink, camera: str, *, wait: Callable[[float], None] = time.sleep
) -> Iterator[Sighting]:
    """Yield live images of a station's camera and its tracker's poses at 5 Hz, indefinitely.

    Raises NotFoundError: no such camera, or no image within 30 s.
    """
    wait_for_camera(link, camera, wait=wait)
    last = b""

    def pose() -> tuple[np.ndarray | None, float]:
        reply = link.request("GET", "/v1/live/poses?mounted=false", accept=MSGPACK)
        fields, found = unpack(reply.body, max_bytes=MAX_POSES_BYTES)
        # The stream of a camera's tracker has the name of the camera.
        T, late_s = found.get(camera), fields.get("late_s", {}).get(camera, 0.0)
        return None if T is None else T.astype(np.float64), late_s

    while True:
        before, _ = pose()
        image = live_image(link, camera)
        if image != last or not image:
            last = image
            after, late_s = pose()
            yield Sighting(image, before, after, max(late_s, image_late_s(link, camera)))
        wait(LIVE_PERIOD_S)


class MountSession:
    """Growing set of places, photos of the board and tracker's poses, as `hand-eye` reads them.

    An ended session can be continued (`is_resumed`), else its places are put aside. Raises
    NotFoundError: no lens yet; InvalidInputError: an ambiguous board, or another one than before.

    Attributes:
        progress: what the places say of the mount, and what is missing.
        newest: board in the newest image; None if there is none.
        is_still: whether board and tracker stood still since the last image.
        hint: why the newest image was not kept; empty if it was.
        size_px: width and height of the images.
    """

    def __init__(self, options: argparse.Namespace, *, is_resumed: bool = False) -> None:
        self._board = parse_board(options.board)
        check_unambiguous(self._board, options.board)
        self._lens, self.size_px = read_lens(options.to, options.camera)
        self._folder: Path = options.photos
        self._wants_place = False
        self._poses: list[np.ndarray] = []
        self._last_T: np.ndarray | None = None
        self.views: list[BoardView] = []
        self.newest: BoardView | None = None
        self.is_tracked = self.is_still = False
        self.hint = ""
        if not is_resumed:
            put_aside(self._folder)
        with disk_errors(f"make {self._folder}"):
            self._folder.mkdir(parents=True, exist_ok=True)
        self._read(options.board)
        self.progress = self._progress()

    @property
    def num_kept(self) -> int:
        """Number of places kept."""
        return len(self.views)

    def take(self) -> None:
        """Keep the present place as soon as the camera is still, even if it is near another one."""
        self._wants_place = True

    def drop(self) -> None:
        """Forget the last place; nothing happens if there is none."""
        if not self.views:
            return
        photo = self._folder / self.views.pop().name
        self._poses.pop()
        self._write()
        photo.unlink(missing_ok=True)
        self.progress = self._progress()

    def add(self, sighting: Sighting) -> None:
        """Look at a live image, and keep its place if it is new and the camera is still."""
        photo, view = None, None
        if sighting.image:
            photo = decode_photo(sighting.image, where="live image")
            self._check_size(photo)
            view = find_board(f"place_{self._number():04d}.jpg", photo, self._board)
        before, self.newest = self.newest, view
        T, last_T = sighting.T_after, self._last_T
        self._last_T, self.is_tracked = T, T is not None
        self.is_still = (
            view is not None
            and before is not None
            and motion_px(view, before) <= MAX_MOTION_PX
            and not view.is_blurred
            and all(
                pose is not None and T is not None and _is_near(pose, T, MAX_SWAY_RAD, MAX_SWAY_M)
                for pose in (last_T, sighting.T_before)
            )
        )
        self.hint = self._why_not(sighting, view)
        if self.hint or view is None or T is None:
            return
        self._wants_place = False
        with disk_errors(f"write {self._folder}"):
            (self._folder / view.name).write_bytes(sighting.image)
        self.views.append(view)
        self._poses.append(T)
        self._write()
        self.progress = self._progress()

    def archive(self, name: str) -> None:
        """Keep the places beside the session's folder, so that the next session begins anew."""
        with disk_errors(f"rename {self._folder}"):
            self._folder.rename(self._folder.with_name(name))

    def _why_not(self, sighting: Sighting, view: BoardView | None) -> str:
        T, is_full = sighting.T_after, len(self.views) >= MAX_PLACES
        # Otherwise the next drop would be followed by a place that nobody wants any more.
        self._wants_place = self._wants_place and not is_full
        # The first that applies.
        reasons = (
            (not sighting.image, "the camera sends no image"),
            (
                view is None,
                "the board is not seen: show all of it, well lit; does the entered board match?",
            ),
            (T is None, "the tracker is not seen"),
            (
                sighting.late_s > MAX_LATE_S,
                f"images or poses arrive {sighting.late_s:.1f} s late, so that they do not belong "
                "together: the station is overloaded; close its other programs, or send smaller "
                "images",
            ),
            (not self.is_still, "moving, or blurred: hold still"),
            (
                is_full,
                f"{MAX_PLACES} places are kept: drop some, or write the mount as it is",
            ),
            (self._wants_place, ""),
            (self._is_kept(T), "this place is kept: go on to the next one"),
        )
        return next((words for applies, words in reasons if applies), "")

    def _is_kept(self, T: np.ndarray | None) -> bool:
        return T is not None and any(
            _is_near(kept, T, MIN_NEW_TURN_RAD, MIN_NEW_SHIFT_M) for kept in self._poses
        )

    def _check_size(self, photo: np.ndarray) -> None:
        got = (photo.shape[1], photo.shape[0])
        if got != self.size_px:
            raise InvalidInputError(
                f"live image: got {got[0]} by {got[1]} px, but K was measured at "
                f"{self.size_px[0]} by {self.size_px[1]}; calibrate the lens in this mode"
            )

    def _number(self) -> int:
        return int(self.views[-1].name[6:10]) + 1 if self.views else 0

    def _progress(self) -> MountProgress:
        return PosedViews.of(self.views, np.array(self._poses), self._lens).progress()

    def _write(self) -> None:
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(PhotoPose.model_fields)
        for view, T in zip(self.views, self._poses, strict=True):
            writer.writerow([view.name, *map(float, pose_from_transform(T))])
        with disk_errors(f"write {self._folder}"):
            replace_file(self._folder / POSES_FILE, text.getvalue().encode())

    def _read(self, board: str) -> None:
        path = self._folder / BOARD_FILE
        if path.is_file() and (kept_board := path.read_text(encoding="utf-8")) != board:
            raise InvalidInputError(
                f"hand-eye: the kept places are of the board {kept_board!r}, got {board!r}; enter "
                "that board, or begin anew"
            )
        with disk_errors(f"write {path}"):
            replace_file(path, board.encode())
        if num_kept_places(self._folder) == 0:
            return
        for name, T in poses_of_photos(self._folder / POSES_FILE, POSES_HELP).items():
            photo = decode_photo((self._folder / name).read_bytes(), where=name)
            view = find_board(name, photo, self._board)
            if view is not None:
                self.views.append(view)
                self._poses.append(T)


def num_kept_places(folder: Path) -> int:
    """How many places an ended session kept in its folder."""
    path = folder / POSES_FILE
    return max(0, len(path.read_bytes().splitlines()) - 1) if path.is_file() else 0


def put_aside(folder: Path) -> None:
    """Rename the folder of an ended session, by the time of its last change."""
    if folder.is_dir():
        changed = time.strftime("%Y%m%d-%H%M%S", time.gmtime(folder.stat().st_mtime))
        with disk_errors(f"rename {folder}"):
            folder.rename(folder.with_name(f"{folder.name}-{changed}"))


def _is_near(T_a: np.ndarray, T_b: np.ndarray, angle_rad: float, distance_m: float) -> bool:
    apart = invert(T_a) @ T_b
    return bool(
        rotation_angle(apart[:3, :3]) < angle_rad and np.linalg.norm(apart[:3, 3]) < distance_m
    )
