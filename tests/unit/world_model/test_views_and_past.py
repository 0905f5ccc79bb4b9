"""Past images and further views: what is chosen, what it changes, and that rollouts keep it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from httpx import ASGITransport, AsyncClient
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, ShapeError
from dextouch.hands.actions import CAMERA_HEAD, reanchor
from dextouch.schemas import ReturnSelector, StartRequest, decode_answer, encode_start
from dextouch.worlds import create_world_app
from services.evaluation.recorded_takes import read_takes
from services.pipelines import evaluate
from services.world_model.checkpoints import read_checkpoint, write_checkpoint
from services.world_model.joint_world import JointWorld
from services.world_model.network.inputs import MAX_KEPT, PastRule, build_inputs
from services.world_model.network.model import JointWorldModel, Sampling
from services.world_model.paper_settings import WindowSettings
from services.world_model.plan import plan_of
from services.world_model.pretrained_video import load_pretrained
from services.world_model.settings import WorldModelSettings
from services.world_model.training import joint_trainer
from services.world_model.training.joint_dataset import (
    WindowPosition,
    WindowSampler,
    index_episodes,
    load_episodes,
    stack_windows,
)
from services.world_model.training.joint_objective import errors, examples_of
from tests.unit.world_model.conftest import make_episode, make_metadata, write_episode
from tests.unit.world_model.test_clean_tokens import noise_of
from tests.unit.world_model.test_joint_world import make_start
from tests.unit.world_model.wan.conftest import (
    autoencoder,
    enlarged,
    full_config,
    pretrained_folder,
    text_encoder,
    transformer,
    wan_config,
)

__all__ = [
    "autoencoder", "full_config", "pretrained_folder", "text_encoder", "transformer", "wan_config",
]  # fmt: skip

LEFT, RIGHT = "camera_wrist_left", "camera_wrist_right"
BOTH = {"further_views": (LEFT, RIGHT), "past_images": 2, "past_stride": 4}


def with_wrists(episode):
    """The wrists see other parts of the head's image, in other colours."""
    left = np.roll(episode.images, 7, axis=2)[..., ::-1].copy()
    return replace(episode, further=(left, 255 - episode.images))


def shaken(model):
    torch.manual_seed(1)
    for name, parameter in model.named_parameters():
        if not name.startswith("codec"):
            parameter.data.add_(0.05 * torch.randn(parameter.shape))
    return model.eval().requires_grad_(requires_grad=False)


@pytest.fixture(params=["tiny", "wan"])
def model(request, tiny_config):
    """The small network and Wan2.2 in miniature, with two wrists and two past images."""
    torch.manual_seed(0)
    if request.param == "tiny":
        model = shaken(JointWorldModel(tiny_config.model_copy(update=BOTH)))
        model.codec.fit(torch.from_numpy(with_wrists(make_episode(0)).images[None, :17].copy()))
        return model
    config = request.getfixturevalue("full_config").model_copy(update=BOTH)
    model = JointWorldModel(config)
    load_pretrained(model, request.getfixturevalue("pretrained_folder"))
    return shaken(model)


@pytest.fixture
def episode(model):
    made = make_episode(3)
    return with_wrists(made if model.config.image_px == 32 else enlarged(made))


def place(model, **changes):
    past = changes.pop("past", PastRule.of(model.config))
    return WindowPosition(0, 16, 17, "commanded", past=past, **changes)


def predicted(model, *requests, steps=2, **options):
    inputs = build_inputs(requests, model.config)
    sampling = Sampling(steps, **options)
    return model.predict(inputs, noise_of(model, len(requests)), sampling=sampling)


def changed_in(one, other):
    return [not torch.equal(getattr(one, n), getattr(other, n)) for n in ("images", "tactile_kpa")]


def test_the_nearest_images_are_those_taken_from_where_the_head_returns_to():
    actions = np.tile(make_episode(0).actions["measured"][:1], (9, 1))
    kept = np.tile(actions[:1], (6, 1))
    # The head was at 0, 10, 20, 30, 20 and 11 cm, and goes on from 3 to 19 cm.
    kept[:, CAMERA_HEAD.start] = [0.0, 0.1, 0.2, 0.3, 0.2, 0.11]
    actions[:, CAMERA_HEAD.start] = np.linspace(0.03, 0.19, 9)
    rule = PastRule(2, "nearest", 4)
    # At its end, 19 cm, the newer of two; amid, 11 cm.
    assert rule.chosen(kept, actions) == [4, 5]
    assert PastRule(3, "nearest", 4).chosen(kept, actions) == [2, 4, 5]
    assert PastRule(2, "recent", 4).chosen(kept, actions) == [4, 5]
    assert rule.chosen(kept[:1], actions) == [0]
    assert rule.steps(11).tolist() == [3, 7]
    assert replace(rule, kept=1).steps(11).tolist() == [7]
    assert rule.steps(4).tolist() == [0]
    assert len(rule.steps(0)) == len(replace(rule, kept=0).steps(11)) == 0
    assert len(rule.steps(1000)) == MAX_KEPT


def test_a_turn_of_the_head_counts_as_what_it_looks_away_from():
    kept = np.tile(make_episode(0).actions["measured"][:1], (2, 1))
    # A fifth of a radian at half a metre against 3 cm.
    kept[0, CAMERA_HEAD] = [0, 0, 0, np.cos(0.2), 0, -np.sin(0.2), 0, 1, 0]
    kept[1, CAMERA_HEAD.start] += 0.03
    actions = np.tile(make_episode(0).actions["measured"][:1], (5, 1))
    assert PastRule(1, "nearest", 4).chosen(kept, actions) == [1]


def test_every_view_and_past_image_tells_but_a_missing_one_tells_nothing(model, episode):
    request = episode.cut(place(model)).request
    base = predicted(model, request)
    shape = tuple(base.further.shape[1:3])
    assert shape == (2, 16)
    dark = tuple(np.zeros_like(one) for one in request.further_images)
    past = replace(request.past, images=np.zeros_like(request.past.images))
    assert len(request.past.ages) == 2
    for other in (replace(request, further_images=dark), replace(request, past=past)):
        assert changed_in(base, predicted(model, other)) == [True, True]
    hidden = replace(request, further_images=(None, request.further_images[1]))
    images = request.past.images.copy()
    images[:, 1] = 77
    unseen = replace(hidden, past=replace(request.past, images=images))
    assert changed_in(predicted(model, hidden), predicted(model, unseen)) == [False, False]
    seen = replace(request, past=replace(request.past, images=images))
    assert changed_in(base, predicted(model, seen)) == [True, True]


def test_sampler_steps_and_kept_contexts_share_past_and_views(model, episode):
    model.config = model.config.model_copy(update={"use_scene_encoder": False})
    requests = [episode.cut(replace(place(model), start=s)).request for s in (0, 3, 16)]
    plain = predicted(model, *requests, steps=3, keep_context=False)
    shared = predicted(model, *requests, steps=3)
    alone = predicted(model, requests[0], steps=3)
    for name in ("images", "further", "tactile_kpa"):
        torch.testing.assert_close(getattr(shared, name), getattr(plain, name), rtol=0, atol=1e-4)
    torch.testing.assert_close(alone.images[0], shared.images[0], rtol=0, atol=1e-5)
    inputs = build_inputs(requests, model.config)
    keys = inputs.first_step_keys()
    other = replace(inputs, past_age=inputs.past_age + 1).first_step_keys()
    assert len(set(keys)) == 3
    assert not set(keys) & set(other)


def test_missing_past_images_are_the_first_image(model, episode):
    request = episode.cut(place(model, past=None)).request
    first = np.stack([request.first_image, *request.further_images])[None].repeat(2, axis=0)
    inputs = model.with_past(build_inputs([request], model.config))
    context = model.context(inputs, model.first_latents(inputs))
    expected = model._encoded(torch.from_numpy(first)[:, :, None])[:, 0]
    torch.testing.assert_close(context.past[0], expected, rtol=0, atol=1e-6)


def test_missing_views_do_not_count_in_the_loss(model, episode):
    def loss(images):
        window = episode.cut(place(model, hidden=frozenset({0})))
        further = window.further.copy()
        further[0] = images
        batch = stack_windows([replace(window, further=further)])
        made = examples_of(model, batch, generator=torch.Generator().manual_seed(0))
        return errors(model, made, "float32").video.item()

    assert loss(0) == pytest.approx(loss(200), rel=1e-6)
    assert loss(0) > 0


def test_a_plan_counts_the_tokens_of_views_and_past(model, episode):
    config = model.config
    less = plan_of(config.model_copy(update={"further_views": (), "past_images": 0}))
    more, across = plan_of(config), config.tokens_per_latent
    assert less.num_video_tokens == 5 * across
    assert more.num_video_tokens == 3 * (5 + 2) * across
    flops = [{w.name: w.flops for w in plan.work} for plan in (less, more)]
    # Three images, and as much touch.
    encoded, without = (one["encode the first image"] for one in flops[::-1])
    assert 2.8 * without < encoded < 3 * without
    inputs = model.with_past(build_inputs([episode.cut(place(model)).request], config))
    context, noise = model.context(inputs, model.first_latents(inputs)), noise_of(model, 1)
    context = replace(context, clean=model.clean_tokens(context, noise))
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        model.denoise(context, noise, torch.ones(1))
    assert flops[1]["one sampler step"] == counter.get_total_flops()


@pytest.fixture
def world(tiny_config, tmp_path):
    config = tiny_config.model_copy(update=BOTH)
    torch.manual_seed(0)
    model = shaken(JointWorldModel(config))
    batch = WindowSampler([make_episode(s) for s in range(3)], np.random.default_rng(0),
                          max_steps=17).draw(16, 17)  # fmt: skip
    model.codec.fit(batch.images)
    model.tokenizer.fit(batch.tactile_kpa.flatten(0, 1))
    path = tmp_path / "seeing.safetensors"
    metadata = make_metadata(config).model_copy(update={"view_dropout": 0.1})
    write_checkpoint(path, model, metadata)
    return JointWorld(read_checkpoint(path))


def start_of(episode, *cameras):
    start = make_start(episode)
    views = dict(zip((LEFT, RIGHT), episode.further, strict=True))
    images = start.observation.images | {name: views[name][:1] for name in cameras}
    return replace(start, observation=replace(start.observation, images=images))


EVERY = ReturnSelector(cameras=("camera_head", LEFT, RIGHT))


def rolled(world, state, actions, sizes, **options):
    seen = []
    for seed, size in enumerate(sizes):
        stepped = world.step(state, actions[:size], seed=seed, **options)
        actions, state = actions[size:], stepped.state
        seen.append(stepped.observation)
    return state, seen


def test_a_rollout_keeps_what_a_window_of_training_is_given(world):
    episode = with_wrists(make_episode(2))
    actions = episode.actions["commanded"][1:]
    state = world.reset(start_of(episode, LEFT, RIGHT)).state
    state, _ = rolled(world, state, actions, (8, 4, 2 * 4))
    # A stride of four steps: each chunk begins with an image to remember.
    assert state.kept.steps == (0, 8, 12)
    assert np.array_equal(state.kept.reached[1:], actions[[7, 11]])
    model = world._model
    first = model.first_latents(
        build_inputs([episode.cut(WindowPosition(0, 0, 5)).request], model.config)
    ).video[0]
    kept = torch.from_numpy(state.kept.latents[0].astype(np.float32))
    torch.testing.assert_close(kept, first, rtol=2e-3, atol=2e-3)
    chunk = np.concatenate([state.reached[None], actions[20:24]])
    past = state.kept.before(state, reanchor(chunk, 0), model.config)
    assert past.ages.tolist() in ([20, 12], [20, 8], [12, 8])
    assert np.allclose(past.actions[-1], reanchor(np.stack([state.reached, actions[11]]), 0)[1])


def test_restored_rollouts_and_batches_remember_the_same(world):
    episode = with_wrists(make_episode(2))
    actions = episode.actions["commanded"][1:]
    begun = world.reset(start_of(episode, LEFT)).state
    state, _ = rolled(world, begun, actions, (8, 8))
    again = world.restore(world.snapshot(state))
    assert world.snapshot(again) == world.snapshot(state)
    asked = ReturnSelector(cameras=("camera_head", LEFT))
    one, other = (world.step(s, actions[16:24], seed=5, selector=asked) for s in (state, again))
    for name in ("camera_head", LEFT):
        assert np.array_equal(one.observation.images[name], other.observation.images[name])
    # Beside a rollout that has no past yet.
    both = world.step_batch([begun, state], np.stack([actions[:8], actions[16:24]]), seeds=[1, 5])
    near = both[1].observation.images["camera_head"].astype(int)
    assert np.abs(near - one.observation.images["camera_head"]).max() <= 1
    forgetful = replace(state, kept=replace(state.kept, latents=0 * state.kept.latents))
    less = world.step(forgetful, actions[16:24], seed=5).observation.images["camera_head"]
    assert not np.array_equal(less, one.observation.images["camera_head"])


def test_a_rollout_remembers_no_more_than_its_bound(world):
    episode = with_wrists(make_episode(2))
    state = world.reset(start_of(episode)).state
    chunk = episode.actions["commanded"][1:5]
    latents = np.zeros(state.kept.latents.shape[1:], np.float32)
    kept = state.kept
    for step in range(0, 4 * 50, 4):
        kept = kept.with_first(replace(state, step=step), latents, world._model.config)
    assert kept.steps == tuple(range(4 * (50 - MAX_KEPT), 4 * 50, 4))
    full = world.restore(world.snapshot(replace(state, kept=kept, step=200)))
    assert full.kept.steps == kept.steps
    assert len(world.step(full, chunk, seed=0).state.kept.steps) == MAX_KEPT
    cut = replace(kept, steps=kept.steps[:-1])
    with pytest.raises(InvalidInputError, match="own snapshot"):
        world.restore(world.snapshot(replace(state, kept=cut)))


async def test_a_client_that_knows_no_further_views_gets_the_heads_alone(world):
    episode = with_wrists(make_episode(2))
    app = create_world_app({"tiny": world}, WorldModelSettings(), name="world_model")
    transport = ASGITransport(app, raise_app_exceptions=False)
    chunk = episode.actions["commanded"][1:9].tobytes()
    request = StartRequest(world="tiny", task="push_box", seed=4, instruction="push the box")

    async with (
        app.router.lifespan_context(app),
        AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):

        async def begun(start, query=""):
            return await client.post(
                f"/v1/rollouts{query}",
                content=encode_start(request, start),
                headers={"content-type": "application/msgpack"},
            )

        async def images_of(start, query):
            found = decode_answer((await begun(start)).content, max_bytes=10**7)
            answer = await client.post(
                f"/v1/rollouts/{found.rollout.id}/chunks/0{query}",
                content=chunk,
                headers={"content-type": "application/octet-stream; dtype=float64"},
            )
            if answer.status_code != 200:
                return set(found.observation.images), answer.json()["detail"]
            seen = decode_answer(answer.content, max_bytes=10**7).observation.images
            return set(found.observation.images), {n: one.shape for n, one in seen.items()}

        shape = (8, 32, 32, 3)
        for cameras in ((), (LEFT, RIGHT)):
            answered = await images_of(start_of(episode, *cameras), "")
            assert answered == ({"camera_head"}, {"camera_head": shape})
        asked = f"?cameras={LEFT}&cameras=camera_head"
        answered = await images_of(start_of(episode, LEFT), asked)
        assert answered[1] == {LEFT: shape, "camera_head": shape}
        _, refused = await images_of(start_of(episode, RIGHT), asked)
        assert "expected views that the rollout began with" in refused
        shown = await begun(start_of(episode, LEFT), asked)
        images = decode_answer(shown.content, max_bytes=10**7).observation.images
        assert np.array_equal(images[LEFT], episode.further[0][:1])
        absent = await begun(start_of(episode), asked)
        assert absent.status_code == 422
        assert LEFT in absent.json()["detail"]
        (described,) = (await client.get("/v1/worlds")).json()["worlds"]
        assert described["cameras"] == ["camera_head"]
        assert described["optional_cameras"] == [LEFT, RIGHT]


def test_a_model_trained_with_all_views_needs_them(world):
    world._needs_views = True
    with pytest.raises(InvalidInputError, match=f"{LEFT}, {RIGHT}.*--windows.view-dropout"):
        world.reset(start_of(with_wrists(make_episode(2)), LEFT))


def test_without_the_options_nothing_is_new(checkpoint, toy_episode):
    metadata = json.loads(checkpoint.metadata.model_dump_json())
    names = {"further_views", "past_images", "past_choice", "past_stride", "view_dropout"}
    assert not names & {*metadata, *metadata["network"]}
    assert not [n for n in checkpoint.model.state_dict() if "views" in n or "past" in n]
    world = JointWorld(checkpoint)
    assert "optional_cameras" not in world.description.model_dump()
    episode = with_wrists(toy_episode(1))
    state = world.reset(start_of(episode, LEFT)).state
    assert world.snapshot(state) == world.snapshot(world.reset(make_start(episode)).state)
    # Drawn as before: no number of the generator goes to what is off.
    rng, same = np.random.default_rng(0), np.random.default_rng(0)
    WindowSampler([toy_episode(1)], rng, max_steps=17).places(3, 17)
    for _ in range(3):
        same.integers(1), same.integers(25), same.random(), same.random()
    assert rng.bit_generator.state == same.bit_generator.state


@pytest.fixture
def stored(tmp_path):
    """A store of six episodes, the last of which has no right wrist camera."""
    store = EpisodeStore(tmp_path / "store")
    for seed in range(6):
        episode = with_wrists(make_episode(seed))
        further = (episode.further[0], None) if seed == 5 else episode.further
        write_episode(store, replace(episode, further=further), success=True)
    return store


def test_windows_from_disk_are_those_of_memory(stored):
    views = BOTH["further_views"]
    rule = PastRule(2, "nearest", 4)
    loaded = load_episodes(str(stored.root), further_views=views)
    indexed = index_episodes(str(stored.root), further_views=views)
    assert [e.missing for e in loaded] == [(False, False)] * 5 + [(False, True)]
    for kind, chained in (("measured", False), ("commanded", False), ("commanded", True)):
        where = WindowPosition(0, 14, 9, kind, chained, past=rule, hidden=frozenset({0}))
        for a, b in ((loaded[k], indexed[k]) for k in (0, 5)):
            one, other = a.cut(where), b.cut(where)
            assert np.array_equal(one.further, other.further)
            assert one.request.further_images[0] is None
            past, same = one.request.past, other.request.past
            assert len(past.ages) == 2
            assert np.array_equal(past.images, same.images)
            assert past.ages.tolist() == same.ages.tolist()
            assert np.allclose(past.actions, same.actions, atol=1e-9)
            steps = where.start - past.ages
            assert np.array_equal(past.images[:, 0], a.images[steps])
            assert np.array_equal(past.images[:, 1], 0 * a.images[steps])


def test_training_with_both_is_that_in_parts_and_can_be_resumed(
    stored, train_settings, tiny_config, tmp_path
):
    config = tiny_config.model_copy(update=BOTH)
    given = train_settings.model_copy(update={"network": config, "max_steps": 3})
    report = joint_trainer.train(given)
    assert np.isfinite(report.metrics["psnr"])
    checkpoint = read_checkpoint(given.output)
    assert checkpoint.metadata.view_dropout == 0.1
    assert checkpoint.model.views.absent.abs().max() > 0
    parts = given.model_copy(update={"accumulate": 2, "output": tmp_path / "parts.safetensors"})
    joint_trainer.train(parts)
    for name, weight in read_checkpoint(parts.output).model.state_dict().items():
        torch.testing.assert_close(
            weight, checkpoint.model.state_dict()[name], rtol=1e-3, atol=1e-4, msg=name
        )
    again = given.model_copy(update={"output": tmp_path / "again.safetensors"})
    joint_trainer.train(
        again.model_copy(update={"init": given.output, "new_tasks": False, "max_steps": 1})
    )
    other = given.model_copy(update={"init": given.output, "network": tiny_config})
    with pytest.raises(ConflictError, match="past_images"):
        joint_trainer.train(other)


def test_a_model_that_may_lack_views_still_may_after_further_training(
    train_settings, tiny_config, tmp_path
):
    config = tiny_config.model_copy(update={"further_views": (LEFT, RIGHT)})
    trained, heldout = ([with_wrists(make_episode(s)) for s in part] for part in ((0, 1), (2,)))
    first = train_settings.model_copy(update={"network": config, "max_steps": 1})
    joint_trainer.train_on(trained, heldout, first)
    windows = first.windows.model_copy(update={"view_dropout": 0.0})
    adapted = first.model_copy(
        update={
            "init": first.output,
            "output": tmp_path / "adapted.safetensors",
            "windows": windows,
            "new_tasks": False,
        }
    )
    joint_trainer.train_on(trained, heldout, adapted)
    checkpoint = read_checkpoint(adapted.output)
    assert checkpoint.metadata.view_dropout == 0.1
    JointWorld(checkpoint).reset(start_of(heldout[0], LEFT))
    always = adapted.model_copy(update={"init": None})
    joint_trainer.train_on(trained, heldout, always)
    assert read_checkpoint(always.output).metadata.view_dropout == 0.0


def test_recorded_takes_start_with_the_views_that_the_world_sees(
    stored, world, tmp_path, monkeypatch
):
    takes = read_takes([stored], further_views=world.description.optional_cameras)
    seen = {take.episode_id: set(take.start.observation.images) for take in takes}
    assert seen.pop("toy-5") == {"camera_head", LEFT}
    assert list(seen.values()) == 5 * [{"camera_head", LEFT, RIGHT}]
    assert set(read_takes([stored])[0].start.observation.images) == {"camera_head"}

    def asked(stores, *, further_views, **options):
        raise InvalidInputError(f"asked for {further_views}")

    monkeypatch.setattr(evaluate, "read_takes", asked)
    words = ["--episodes", str(stored.root), "--checkpoint", str(tmp_path / "seeing.safetensors")]
    with pytest.raises(InvalidInputError, match=f"asked for .*{LEFT}.*{RIGHT}"):
        evaluate.recorded_main(words)


def test_episodes_without_a_needed_view_are_refused_by_name(stored, train_settings, tiny_config):
    config = tiny_config.model_copy(update={"further_views": (LEFT, RIGHT)})
    windows = WindowSettings(fit_windows=16, view_dropout=0.0)
    given = train_settings.model_copy(update={"network": config, "windows": windows})
    with pytest.raises(InvalidInputError, match=r"1 of 6 episodes.*wrist_right.*toy-5"):
        joint_trainer.train(given)


def test_wrong_numbers_of_views_and_past_images_are_refused(model, episode):
    request = episode.cut(place(model)).request
    for changed in (
        replace(request, further_images=request.further_images[:1]),
        replace(request, past=replace(request.past, images=request.past.images[:, :1])),
        replace(request, past=replace(request.past, images=None)),
    ):
        with pytest.raises(ShapeError, match=r"further views|past images"):
            build_inputs([changed], model.config)
    with pytest.raises(ValueError, match="each once"):
        type(model.config).model_validate(
            model.config.model_dump() | {"further_views": (LEFT, LEFT)}
        )
