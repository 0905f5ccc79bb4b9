"""Consistency check of a recording's camera matrices with the sizes of its images."""

from collections.abc import Mapping

import numpy as np

from dextouch.errors import InvalidInputError
from dextouch.schemas import Matrix
from dextouch.streams import StreamDescriptor


def check_lenses(
    calibration: Mapping[str, Matrix], streams: Mapping[str, StreamDescriptor], *, where: str
) -> None:
    """Refuse a camera matrix that was measured on images of another size than were recorded.

    Matrices that are absent are not asked for. Images are never undistorted here: the episode
    carries `distortion_<camera>` beside `K_<camera>`.

    Raises:
        InvalidInputError: sizes that differ, or a matrix of the wrong shape.
    """
    for name, stream in streams.items():
        camera = name.removeprefix("camera_")
        if stream.kind != "image" or camera == name:
            continue
        for matrix, shape in (
            (f"K_{camera}", (3, 3)),
            (f"distortion_{camera}", (1, 5)),
            (f"image_size_{camera}_px", (1, 2)),
        ):
            if matrix in calibration and np.shape(calibration[matrix]) != shape:
                raise InvalidInputError(
                    f"{where}: calibration {matrix!r} is {np.shape(calibration[matrix])}, expected "
                    f"{shape}"
                )
        size_px = calibration.get(f"image_size_{camera}_px")
        recorded = (stream.shape[1], stream.shape[0])
        if size_px is not None and tuple(size_px[0]) != recorded:
            raise InvalidInputError(
                f"{where}: K_{camera} was measured on images of {size_px[0][0]:g} by "
                f"{size_px[0][1]:g} px, but {name!r} holds {recorded[0]} by {recorded[1]}; "
                "calibrate the camera in the mode that is recorded"
            )
