"""Objects of other sizes, against the same scene compiled with these sizes."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.schemas import RolloutStart
from services.twin.episodes import record
from services.twin.scene import Geometry, Sizes, compile_scene
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions, episode_id
from services.twin.world import TwinWorld


@pytest.fixture(scope="module")
def stage():
    return Stage("stand_bottle", "robot", TwinSettings(image_height_px=16, image_width_px=16))


def taken(stage, **sizes):
    options = TakeOptions(images=(), streams="training", sizes=Sizes(**sizes))
    return record(stage, 40000, options)


def body(*sizes):
    """A body of a cylinder about z and of two boxes, one of them turned a quarter about x."""
    (radius, length), thin, turned = sizes
    return (
        '<body name="thing"><freejoint/>'
        f'<geom class="object" type="cylinder" mass="0.1" size="{radius} {length}"/>'
        f'<geom class="object" type="box" mass="0.1" size="{thin}" pos="0.04 0 0.1"/>'
        f'<geom class="object" type="box" mass="0.1" size="{turned}" euler="1.5707963 0 0"/></body>'
    )


def test_geometry_is_that_of_a_scene_compiled_with_these_sizes():
    usual = body((0.02, 0.1), "0.01 0.02 0.03", "0.01 0.02 0.03")
    scaled = body((0.016, 0.11), "0.008 0.016 0.033", "0.008 0.022 0.024")
    scaled = scaled.replace("0.04 0 0.1", "0.032 0 0.11")
    names = {"object_names": ("thing",)}
    scene = compile_scene("robot", objects=usual, **names)
    other = compile_scene("robot", objects=scaled, **names).model
    Geometry(scene).resize(Sizes(width=0.8, height=1.1))
    for field in ("geom_size", "geom_pos", "geom_rbound", "geom_aabb"):
        ours, theirs = getattr(scene.model, field), getattr(other, field)
        # A sphere about a resized geom may be too large, as may a cylinder's.
        if field == "geom_rbound":
            assert (ours >= theirs - 1e-9).all()
        else:
            np.testing.assert_allclose(ours, theirs, atol=1e-6, err_msg=field)


@pytest.mark.long
def test_a_thin_bottle_lies_lower_and_slips_from_the_hand_that_closes_for_a_usual_one(stage):
    thin, usual, thick = (taken(stage, width=width) for width in (0.8, 1.0, 1.2))
    for take, radius_m in ((thin, 0.0272), (usual, 0.034), (thick, 0.0408)):
        assert take.attributes.object_boxes_m[0][3] == pytest.approx(radius_m, abs=1e-6)
        height_m = take.streams["object_poses"].values[0].reshape(-1)[2]
        assert height_m == pytest.approx(radius_m, abs=3e-4)
    assert (thin.attributes.success, usual.attributes.success) == (False, True)


@pytest.mark.long
def test_a_take_after_one_of_other_sizes_is_as_always(stage):
    before = taken(stage)
    taken(stage, width=1.3, height=0.9)
    after = taken(stage)
    for name, stream in before.streams.items():
        np.testing.assert_array_equal(stream.values, after.streams[name].values)
    assert before.attributes == after.attributes


def test_sizes_are_in_the_id_and_the_command_of_a_take(stage):
    options = TakeOptions(sizes=Sizes(0.8, 1.1))
    assert episode_id("stand_bottle", "robot", 3, options).endswith("-w800h1100")
    assert options.words()[-4:] == ["--width", "0.8", "--height", "1.1"]
    assert taken(stage, width=0.8).attributes.quality["width"] == 0.8


def test_drawn_sizes_differ_and_stay_near_the_usual_ones():
    drawn = [Sizes.drawn(np.random.default_rng(seed)) for seed in range(200)]
    widths = np.array([one.width for one in drawn])
    assert widths.min() < 0.8
    assert widths.max() > 1.2
    assert all(0.9 <= one.height <= 1.1 for one in drawn)


@pytest.mark.parametrize("width", [0.4, 1.6, float("nan")])
def test_impossible_sizes_are_refused(width):
    with pytest.raises(InvalidInputError, match="usual width"):
        Sizes(width=width)


@pytest.mark.long
def test_fixed_objects_keep_their_size():
    stage = Stage("insert_peg", "robot", TwinSettings(image_height_px=16, image_width_px=16))
    usual = taken(stage).attributes.object_boxes_m
    wide = taken(stage, width=1.2).attributes.object_boxes_m
    assert wide[0][3] == pytest.approx(1.2 * usual[0][3])
    assert wide[1] == usual[1]


@pytest.mark.long
def test_rollouts_of_a_twin_with_other_sizes_begin_and_stay_with_them():
    settings = TwinSettings(cameras=(), image_height_px=16, image_width_px=16, object_width=0.8)
    twin = TwinWorld(settings)
    assert twin.description.digest != TwinWorld(TwinSettings(cameras=())).description.digest
    for seed in (40000, 40001):
        twin.reset(RolloutStart("stand_bottle", seed, ""))
        height_m = twin.stage("stand_bottle").simulation.object_poses()[0, 2]
        assert height_m == pytest.approx(0.0272, abs=3e-4)
