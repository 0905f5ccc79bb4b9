"""Stress of the joint flow-matching model, chunk after chunk."""

from functools import cache

import numpy as np
import torch

from benchmarks.stress import worlds
from benchmarks.stress.cells import Check, StageCells
from benchmarks.stress.worlds import Subject
from benchmarks.world_model.coarse import with_coarse_products
from dextouch.streams import HEAD_CAMERA
from services.world_model.checkpoints import Checkpoint, read_checkpoint
from services.world_model.joint_world import JointWorld
from services.world_model.network.flow_matching import add_noise, sample, shift_time
from services.world_model.network.inputs import PredictionRequest, build_inputs
from services.world_model.network.model import JointWorldModel, stack_noise
from services.world_model.shipped_checkpoints import paper_form_checkpoint

STAGE = StageCells("world-model")
# Bounds of the current model in bfloat16; its own touch error is larger.
_BFLOAT16_KPA, _BFLOAT16_LEVELS = 5.0, 12
# Target of the roadmap: hands that stand still without contact feel nothing.
_STILL_KPA = 2.0


@STAGE.cell("ends", "flow times 0 and 1, one Euler step; chunks of 4 and 16 steps and beyond")
def _ends(check: Check) -> None:
    clean, noise = torch.randn(2, 3, 4), torch.randn(2, 3, 4)
    for t, expected in ((0.0, clean), (1.0, noise)):
        got = add_noise(clean, noise, torch.full((2,), t))
        check.equal(f"noisy latents at t = {t:g}", got.numpy(), expected.numpy())
        shifted = shift_time(torch.tensor([t]), 5.0)
        check.at_most("shifted ends of time off", abs(float(shifted) - t), 0.0)
    for steps in (1, 2, 64):
        video, _ = sample(lambda *_: (clean, clean), (noise, noise), num_steps=steps, shift=3.0)
        check.equal("the last step lands on the guess", video.numpy(), clean.numpy())
    check.refused(
        "no step",
        lambda: sample(lambda *_: (clean, clean), (noise, noise), num_steps=0, shift=3.0),
    )
    worlds.check_chunk_ends(check, _subject())


@STAGE.cell("precision", "matrix products in bfloat16; weights in bfloat16, float16 and float64")
def _precision(check: Check) -> None:
    subject = _subject()
    exact = subject.step(subject.actions[:16])
    coarse_worlds = {"bfloat16 products": JointWorld(with_coarse_products(_checkpoint()))}
    for dtype in (torch.bfloat16, torch.float16, torch.float64):
        model = read_checkpoint(paper_form_checkpoint()).model.to(dtype)
        checkpoint = Checkpoint(model, _checkpoint().metadata, _checkpoint().digest)
        coarse_worlds[f"weights {dtype}"] = JointWorld(checkpoint)
    for name, world in coarse_worlds.items():
        coarse = Subject(world, subject.begun).step(subject.actions[:16])
        worlds.check_answer(check, coarse)
        off_kpa = np.abs(coarse.tactile_kpa - exact.tactile_kpa).max()
        check.at_most(f"{name}: touch off", off_kpa, _BFLOAT16_KPA, "kPa")
        off = np.abs(coarse.images[HEAD_CAMERA].astype(int) - exact.images[HEAD_CAMERA]).max()
        check.at_most(f"{name}: images off", off, _BFLOAT16_LEVELS, "levels")


@STAGE.cell(
    "device",
    "the network on the meta device, where a tensor made elsewhere is found out",
    slow=True,
)
def _device(check: Check) -> None:
    model = JointWorldModel(_checkpoint().metadata.network).eval().to("meta")
    subject = _subject()
    seen, start = subject.begun.observation, subject.begun.policy_start
    request = PredictionRequest(
        first_image=seen.images[HEAD_CAMERA][0],
        first_tactile_kpa=seen.tactile_kpa[0],
        actions=np.concatenate([subject.still(1), subject.actions[:16]]),
        action_kind="commanded",
        instruction=start.instruction,
        anchor=start.anchor,
        K_head=start.K_head,
    )
    inputs = build_inputs([request, request], model.config)
    noise = model.noise(17, torch.Generator().manual_seed(0))
    future = model.predict(inputs, stack_noise([noise, noise]))
    px = model.config.image_px
    check.true("images on the weights' device", future.images.device.type == "meta")
    check.true("images of 16 steps", tuple(future.images.shape) == (2, 16, px, px, 3))
    check.true("touch of 16 steps", tuple(future.tactile_kpa.shape) == (2, 16, 2, 320))


@STAGE.cell("long_run", "hands that stand still with nothing near: 63 chunks", slow=True)
def _long_run(check: Check) -> None:
    peak_kpa = worlds.peak_kpa(worlds.stand_still(_subject()))
    check.finite("touch of all chunks", np.array(peak_kpa))
    check.at_most("peak of any chunk", peak_kpa, _STILL_KPA, "kPa")


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion; see hand-eye",
    clock="steps are counted, there is no clock; see clocks",
)


@cache
def _checkpoint() -> Checkpoint:
    return read_checkpoint(paper_form_checkpoint())


@cache
def _subject() -> Subject:
    world = JointWorld(_checkpoint())
    return Subject(world, worlds.demonstration(world.description.image_width_px))


worlds.add_shared_cells(STAGE, _subject, lambda: float(_checkpoint().model.tokenizer.peak_kpa))
