"""Rotations, rigid transforms, interpolation and pinhole cameras in float64."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.geometry import rotations as rotations
    from dextouch.geometry.interpolation import bracket as bracket
    from dextouch.geometry.interpolation import interpolate_linear as interpolate_linear
    from dextouch.geometry.interpolation import interpolate_poses as interpolate_poses
    from dextouch.geometry.interpolation import nearest_index as nearest_index
    from dextouch.geometry.lens import box_pixels as box_pixels
    from dextouch.geometry.lens import lens_pixels as lens_pixels
    from dextouch.geometry.lens import points_on_level as points_on_level
    from dextouch.geometry.transforms import apply as apply
    from dextouch.geometry.transforms import invert as invert
    from dextouch.geometry.transforms import pinhole_matrix as pinhole_matrix
    from dextouch.geometry.transforms import pose_from_transform as pose_from_transform
    from dextouch.geometry.transforms import project as project
    from dextouch.geometry.transforms import rigid_error as rigid_error
    from dextouch.geometry.transforms import transform as transform
    from dextouch.geometry.transforms import transform_from_pose as transform_from_pose
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
