"""The rollout codec: round trips, the golden bytes of the documented format, and refusals."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.errors import DegenerateRotationError, InvalidInputError, NonFiniteError, ShapeError
from dextouch.schemas import (
    EVERYTHING,
    Observation,
    ReturnSelector,
    RolloutInfo,
    RolloutOrigin,
    RolloutStart,
    RolloutUncertainty,
    StartRequest,
    Uncertainty,
    answer_parts,
    decode_answer,
    decode_observation,
    decode_start,
    encode_observation,
    encode_start,
    rollout_uncertainty,
)
from dextouch.schemas.observations import ObservationFields, check_observation_arrays
from dextouch.streams import pack, unpack
from tests.unit.worlds.fakes import CAMERAS, K_HEAD, anchor, observation

GOLDEN = Path(__file__).parent / "golden"
INFO = RolloutInfo(
    id="0" * 32,
    world="twin",
    world_digest="d" * 64,
    task="stand_bottle",
    instruction="stand the bottle",
    seed=3,
    action_kind="commanded",
    next_chunk=1,
    last_step=2,
    ttl_s=600.0,
)
REQUEST = StartRequest(world="twin", task="stand_bottle", seed=3, instruction="stand the bottle")


def encode_answer(*args, **options) -> bytes:
    """A response as services send it."""
    return pack(*answer_parts(*args, **options))


def golden_observation() -> Observation:
    """Two steps of numbers that can be checked by eye."""
    return Observation(
        first_step=1,
        images={"camera_head": np.arange(2 * 2 * 2 * 3, dtype=np.uint8).reshape(2, 2, 2, 3)},
        tactile_kpa=np.linspace(0, 10, 1280, dtype=np.float32).reshape(2, 2, 320),
        action_reached=np.linspace(-1, 1, 134).reshape(2, 67),
        reached_is_measured=True,
        success=False,
    )


def imagined_observation() -> Observation:
    """The same as an imagining world gives it: two objects' poses, and uncertainty."""
    poses = np.zeros((2, 2, 7), np.float32)
    poses[:, :, 0] = [[0.25, -0.5], [0.125, -0.5]]
    poses[:, :, 3:] = [0.5, 0.5, -0.5, 0.5]
    return dataclasses.replace(
        golden_observation(),
        reached_is_measured=False,
        success=None,
        object_poses=poses,
        uncertainty=Uncertainty(
            disagreement=0.5, distance=2.25, outside=True, reason="bottle out of view"
        ),
    )


def assert_same(one: Observation, other: Observation) -> None:
    for field in ("first_step", "reached_is_measured", "success", "uncertainty"):
        assert getattr(one, field) == getattr(other, field)
    assert set(one.images) == set(other.images)
    for camera, images in one.images.items():
        np.testing.assert_array_equal(images, other.images[camera])
    np.testing.assert_array_equal(one.tactile_kpa, other.tactile_kpa)
    np.testing.assert_array_equal(one.action_reached, other.action_reached)
    assert (one.object_poses is None) == (other.object_poses is None)
    if one.object_poses is not None:
        np.testing.assert_array_equal(one.object_poses, other.object_poses)


@given(
    num_steps=st.integers(1, 5),
    seed=st.integers(0, 9),
    first_step=st.integers(0, 10**6),
    success=st.sampled_from([None, True, False]),
)
def test_observations_come_back_exactly(num_steps, seed, first_step, success):
    seen = dataclasses.replace(observation(num_steps, seed, first_step), success=success)
    back = decode_observation(encode_observation(seen), max_bytes=10**6)
    assert_same(seen, back)
    assert encode_observation(back) == encode_observation(seen)


def test_answers_come_back_with_info_and_origin():
    seen, origin = observation(4), RolloutOrigin(anchor(), K_HEAD)
    data = encode_answer(INFO, seen, info={"contacts": 2.0}, origin=origin)
    answer = decode_answer(data, max_bytes=10**6)
    assert answer.rollout == INFO
    assert answer.info == {"contacts": 2.0}
    assert_same(answer.observation, seen)
    for one, other in zip(answer.origin.anchor.as_tuple(), anchor().as_tuple(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert decode_answer(encode_answer(INFO, seen), max_bytes=10**6).origin is None


def test_what_an_imagining_world_adds_comes_back():
    seen = imagined_observation()
    answer = decode_answer(encode_answer(INFO, seen), max_bytes=10**6)
    assert_same(answer.observation, seen)
    assert_same(decode_observation(encode_observation(seen), max_bytes=10**6), seen)
    start = RolloutStart("t", 1, "x", "commanded", seen.last(), anchor(), K_HEAD)
    assert_same(
        decode_start(encode_start(REQUEST, start), max_bytes=10**6)[1].observation, seen.last()
    )


def test_what_older_services_do_not_send_is_none():
    old = decode_answer((GOLDEN / "answer.msgpack").read_bytes(), max_bytes=10**6)
    assert (old.observation.object_poses, old.observation.uncertainty) == (None, None)
    assert old.rollout.ended is None


@pytest.mark.parametrize(
    "fields",
    [
        {"disagreement": -1.0},
        {"distance": float("inf")},
        {"disagreement": float("nan")},
        {"outside": True},
        {"reason": "far from everything"},
        {"outside": True, "reason": ""},
        {"success_probability": 1.5},
        {"success_probability": float("nan")},
        {"success_spread": -0.1},
        {"size_deviation": -0.1},
        {"size_deviation": float("inf")},
    ],
)
def test_doubt_that_contradicts_itself_is_refused(fields):
    good = {"disagreement": 0.0, "distance": 0.0, "outside": False, "reason": None}
    Uncertainty.model_validate(good)
    raw, arrays = unpack(encode_observation(observation()), max_bytes=10**6)
    with pytest.raises(InvalidInputError, match="doubt"):
        decode_observation(pack(raw | {"doubt": good | fields}, arrays), max_bytes=10**6)


def test_an_estimate_of_success_comes_back_and_is_omitted_where_there_is_none():
    estimated = Uncertainty(
        disagreement=0, distance=0, success_probability=0.75, success_spread=0.5, size_deviation=0.2
    )
    seen = dataclasses.replace(imagined_observation(), uncertainty=estimated)
    assert_same(decode_answer(encode_answer(INFO, seen), max_bytes=10**6).observation, seen)
    raw, _ = unpack(encode_observation(imagined_observation()), max_bytes=10**6)
    # As services without these fields send it, and as older clients need it.
    assert set(raw["doubt"]) == {"disagreement", "distance", "outside", "reason"}


def test_one_doubted_chunk_makes_the_rollout_unreliable():
    def told(step, probability=None, spread=None, reason=None):
        uncertainty = Uncertainty(
            disagreement=0, distance=0, outside=reason is not None, reason=reason,
            success_probability=probability, success_spread=spread,
        )  # fmt: skip
        return dataclasses.replace(observation(4, first_step=step - 3), uncertainty=uncertainty)

    start = observation(1)
    chunks = [
        told(4, 0.5),
        told(8, 0.25, reason="slipped"),
        told(12, reason="lost"),
        told(16, 1, 0),
    ]
    found = rollout_uncertainty([start, *chunks])
    assert (found.reason, found.step) == ("slipped", 8)
    assert (found.success_probability, found.success_spread) == (1.0, 0.0)
    assert rollout_uncertainty([start, *chunks[:3]]).success_probability is None
    assert rollout_uncertainty([start, chunks[0]]).reason is None
    assert rollout_uncertainty([start]) == RolloutUncertainty()
    # The same by the last step alone, which some clients ask for.
    assert rollout_uncertainty([start, *(one.last() for one in chunks)]) == found


def test_a_doubt_is_kept_as_figures_of_an_episode():
    uncertainty = RolloutUncertainty(
        reason="slipped", step=8, success_probability=0.25, success_spread=0.5, size_deviation=0.2
    )
    quality = uncertainty.to_quality()
    assert set(map(type, quality.values())) == {float}
    back = RolloutUncertainty.from_quality({"residual_mm": 1.0, **quality})
    assert back == uncertainty.model_copy(update={"reason": back.reason})
    assert back.reason is not None
    assert RolloutUncertainty().to_quality() == {}
    assert RolloutUncertainty.from_quality({"residual_mm": 1.0}) == RolloutUncertainty()


def test_the_state_of_a_rollout_carries_its_doubt():
    assert INFO.after(None, 4) == INFO.model_copy(
        update={"next_chunk": INFO.next_chunk + 1, "last_step": INFO.last_step + 4}
    )
    assert "rollout_doubt" not in INFO.after(None, 4).model_dump()
    unreliable = INFO.after(
        Uncertainty(disagreement=0, distance=0, outside=True, reason="slipped"), 4
    )
    later = unreliable.after(Uncertainty(disagreement=0, distance=0), 8).after(None, 4)
    assert later.rollout_uncertainty == RolloutUncertainty(
        reason="slipped", step=INFO.last_step + 4
    )
    assert (later.next_chunk, later.last_step) == (INFO.next_chunk + 3, INFO.last_step + 16)
    answer = decode_answer(encode_answer(later, observation(4)), max_bytes=10**6)
    assert answer.rollout == later


@pytest.mark.parametrize("success", [None, True, False])
def test_fields_are_those_of_their_schema(success):
    for seen in (golden_observation(), imagined_observation()):
        one = dataclasses.replace(seen, success=success)
        by_pydantic = ObservationFields.model_validate(one, from_attributes=True)
        fields, _ = answer_parts(INFO, one)
        assert fields["observation"] == by_pydantic.model_dump(mode="json")


def test_the_last_step_keeps_what_is_of_the_whole_chunk():
    seen = dataclasses.replace(imagined_observation(), success=True)
    assert_same(
        seen.last(),
        dataclasses.replace(
            seen,
            first_step=seen.first_step + 1,
            images={camera: images[1:] for camera, images in seen.images.items()},
            tactile_kpa=seen.tactile_kpa[1:],
            action_reached=seen.action_reached[1:],
            object_poses=seen.object_poses[1:],
        ),
    )


def test_last_step_and_one_camera():
    seen = dataclasses.replace(observation(4, first_step=5), object_poses=poses(4))
    assert seen.selected(EVERYTHING) == seen
    got = seen.selected(ReturnSelector(cameras=(CAMERAS[1],), steps="last"))
    assert (got.first_step, len(got), set(got.images)) == (8, 1, {CAMERAS[1]})
    np.testing.assert_array_equal(got.object_poses, seen.object_poses[-1:])
    np.testing.assert_array_equal(got.tactile_kpa[0], seen.tactile_kpa[-1])
    np.testing.assert_array_equal(got.images[CAMERAS[1]][0], seen.images[CAMERAS[1]][-1])


@pytest.mark.parametrize("cameras", [(), ("",)])
def test_no_camera_at_all(cameras):
    got = observation(4).selected(ReturnSelector(cameras=cameras))
    assert (len(got), got.images) == (4, {})


def poses(num_steps: int) -> np.ndarray:
    """Two objects that move along x, standing."""
    rows = np.zeros((num_steps, 2, 7), np.float32)
    rows[:, :, 0] = np.arange(num_steps)[:, None]
    rows[:, :, 3] = 1.0
    return rows


def test_starts_come_back():
    plain = RolloutStart("stand_bottle", 3, "stand the bottle")
    request, back = decode_start(encode_start(REQUEST, plain), max_bytes=10**6)
    assert (request, back) == (REQUEST, plain)
    full = dataclasses.replace(plain, observation=observation(), anchor=anchor(), K_head=K_HEAD)
    _, back = decode_start(encode_start(REQUEST, full), max_bytes=10**6)
    assert_same(back.observation, full.observation)
    np.testing.assert_array_equal(back.K_head, K_HEAD)
    with pytest.raises(InvalidInputError, match="anchor and K_head"):
        encode_start(REQUEST, dataclasses.replace(full, anchor=None))


@pytest.mark.parametrize(
    ("name", "encode"),
    [
        ("answer", lambda: encode_answer(INFO, golden_observation(), info={"contacts": 2.0})),
        (
            "first_answer",
            lambda: encode_answer(
                INFO.model_copy(update={"next_chunk": 0, "last_step": 0}),
                dataclasses.replace(golden_observation().last(), first_step=0),
                origin=RolloutOrigin(anchor(), K_HEAD),
            ),
        ),
        (
            "imagined_answer",
            lambda: encode_answer(INFO, imagined_observation(), info={"contacts": 2.0}),
        ),
        ("start", lambda: encode_start(REQUEST, RolloutStart("stand_bottle", 3, "x"))),
    ],
)
def test_the_documented_format_does_not_change(name, encode):
    # A change here is a change of docs/rollout_api.md and of its version.
    path = GOLDEN / f"{name}.msgpack"
    assert unpack_all(encode()) == unpack_all(path.read_bytes())
    assert encode() == path.read_bytes()


def unpack_all(data: bytes) -> dict[str, object]:
    fields, arrays = unpack(data, max_bytes=10**6)
    return {"fields": fields, **{name: array.tolist() for name, array in arrays.items()}}


@pytest.mark.parametrize(
    ("changed", "error", "says"),
    [
        ({"tactile_kpa": np.zeros((1, 2, 4097), np.float32)}, ShapeError, "4097"),
        ({"tactile_kpa": np.zeros((1, 2, 320))}, ShapeError, "float64"),
        ({"tactile_kpa": np.zeros((), np.float32)}, ShapeError, "0 steps"),
        ({"tactile_kpa": np.full((1, 2, 320), np.nan, np.float32)}, NonFiniteError, "tactile"),
        ({"action_reached": np.zeros((2, 67))}, ShapeError, "action_reached"),
        ({"action_reached": np.full((1, 67), np.inf)}, NonFiniteError, "action_reached"),
        ({"images": {"a": np.zeros((1, 3, 8, 8), np.uint8)}}, ShapeError, "images of a"),
        ({"images": {"a": np.zeros((2, 8, 8, 3), np.uint8)}}, ShapeError, "images of a"),
        ({"images": {"a": np.zeros((8, 8, 3), np.uint8)}}, ShapeError, "images of a"),
        ({"images": {"a": np.zeros((1, 8, 8, 3), np.float32)}}, ShapeError, "float32"),
        (
            {
                "images": {
                    "a": np.zeros((1, 8, 8, 3), np.uint8),
                    "b": np.zeros((1, 9, 8, 3), np.uint8),
                }
            },
            ShapeError,
            "images of b",
        ),
        ({"object_poses": poses(2)}, ShapeError, "object_poses"),
        ({"object_poses": poses(1)[:, :0]}, ShapeError, "0 objects"),
        ({"object_poses": poses(1)[0]}, ShapeError, "object_poses"),
        ({"object_poses": poses(1).astype(float)}, ShapeError, "float64"),
        ({"object_poses": poses(1) * np.float32(np.nan)}, NonFiniteError, "object_poses"),
        ({"object_poses": poses(1) * np.float32(1.01)}, DegenerateRotationError, "object 0"),
    ],
)
def test_arrays_that_do_not_fit_are_named(changed, error, says):
    seen = observation()
    good = {
        "images": seen.images,
        "tactile_kpa": seen.tactile_kpa,
        "action_reached": seen.action_reached,
    }
    check_observation_arrays(**good, where="test")
    with pytest.raises(error, match=says):
        check_observation_arrays(**(good | changed), where="test")


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("T_world_camera_head", np.diag([2.0, 1, 1, 1]), DegenerateRotationError),
        ("T_world_camera_head", np.diag([-1.0, 1, 1, 1]), DegenerateRotationError),
        ("T_world_wrist_left", np.full((4, 4), np.nan), ShapeError),
        ("T_world_wrist_left", np.eye(3), ShapeError),
        ("K_head", np.eye(3, dtype=np.float32), ShapeError),
    ],
)
def test_poses_that_are_none_are_refused(name, value, error):
    start = RolloutStart("t", 1, "x", "commanded", observation(), anchor(), K_HEAD)
    fields, arrays = unpack(encode_start(REQUEST, start), max_bytes=10**6)
    with pytest.raises(error, match=name):
        decode_start(pack(fields, arrays | {name: value}), max_bytes=10**6)
