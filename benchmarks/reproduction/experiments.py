"""Experiments of the paper in miniature: the data, models and studies of each table, as steps."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, get_args

from pydantic import Field

from benchmarks.reproduction.steps import Step, step_with_result
from dextouch.frozen_model import FrozenModel
from services.twin.names import DOWNSTREAM, HUMAN_PRETRAINING, ROBOT_PRETRAINING

Table = Literal[
    "tokenizer", "options", "instruction", "design", "scaling", "evaluator", "generation"
]
TABLES: Final[tuple[Table, ...]] = get_args(Table)
_CROSS_ATTENTION: Final = (
    "--network.action-conditioning cross_attention --no-network.add-condition-to-tokens"
)
# Columns of the design ablation: the paper's three, without what the default model adds to them. It
# keeps the default's targets and loss, as models of the preset `paper` learn nothing in minutes.
_WITHOUT_ADDITIONS: Final = (
    "--no-network.use-pose-raster --no-network.use-scene-encoder "
    "--no-network.add-condition-to-tokens"
)
DESIGNS: Final = {
    "V-only": f"{_WITHOUT_ADDITIONS} {_CROSS_ATTENTION} --no-network.use-touch",
    "Cross-Attn": f"{_WITHOUT_ADDITIONS} {_CROSS_ATTENTION}",
    "Robot-only": _WITHOUT_ADDITIONS,
}
# Single options of the joint model, each changed from the default.
OPTIONS: Final = {
    "default": "",
    "velocity": "--network.prediction velocity --network.sampling-steps 8",
    "plain video": "--network.video-target plain",
    "plain touch": "--network.tactile-target plain",
    "contact or changing": "--optimizer.touch-loss contact_or_changing",
    "no pose raster": "--no-network.use-pose-raster",
    "all palm axes": "--network.palm-channels 240",
    "no sum with tokens": "--no-network.add-condition-to-tokens",
    "cross-attention": _CROSS_ATTENTION,
    "no scene encoder": "--no-network.use-scene-encoder",
    "no touch": "--no-network.use-touch",
}
INSTRUCTIONS: Final = {"hashed words": "hashed_words", "subwords": "subwords"}
TOKENIZERS: Final = {"Split-Hands": "split_hands", "Grid": "grid"}
ADAPTED: Final = ("WM-Robot", "WM-Mix")
GENERATED: Final = ("Real", "Half", *(f"+{world}" for world in ADAPTED))
# Columns with which the others of their tables are compared.
BASES: Final[dict[Table, str]] = {
    "options": "default",
    "design": "Robot-only",
    "scaling": "0",
    "evaluator": "WM-Robot",
}
# Predictions that hardly depend on the model, measured beside the first seed of these columns.
REFERENCES: Final = ("copy", "warp", "zero", "codec", "true_images")
OTHER_ACTIONS: Final = "other_take"
# Half of the examples of a model with human data are the robot's: without human data, it has seen
# as many of them after half the training.
HALF_TRAINING: Final = "0, half as long"
# Windows of held-out episodes for the short measurement at the end of a training: every n-th.
_SHORT_EVALUATION: Final = "--evaluation-stride 40"
_CANS: Final = "lift_full_can,lift_empty_can,move_can_left,move_can_right"
_FIRST_HELDOUT_SEED: Final = 60_000
_FIRST_STUDY_SEED: Final = 70_000
# Policies beside a cloned one and the same early in training: demonstrators with an error of
# position, and with mistakes of kinds that no data of these experiments have.
SCRIPTS: Final = (
    "script 0 mm",
    "script 10 mm",
    "script 20 mm",
    "script 40 mm",
    "gain 0.5",
    "short 0.5",
    "roll 0.5",
    "shake 0.5",
    "side_approach 0.4",
)
# Whole rollouts from their first step, whose images are those at the ends of chunks.
_STATE_METRICS: Final = (
    "--metrics psnr,tactile_mse,contact_iou,contact_f1,pad_contact_f1,object_error"
)
STATE_REFERENCES: Final = ("copy", OTHER_ACTIONS)
_MODEL: Final = "model.safetensors"
_JUDGE: Final = "judge.safetensors"
# Scenes of downstream episodes that no adapted model has seen: judges are calibrated on them, and
# demonstrations are imagined in them.
_UNSEEN_SPLIT: Final = "A"
_POLICY: Final = "policy.safetensors"
_EARLY_POLICY: Final = "policy_early.safetensors"


class Sizes(FrozenModel):
    """Amounts of data and training; the defaults take some hours on two cores.

    The paper has 5 h of robot and up to 100 h of human data, that is 20 times as much. `multiples`
    are human episodes as multiples of the robot episodes, `pretraining_per_task` robot episodes
    with mistakes for the model that is adapted. `adapt_robot_per_task` are the robot episodes of
    WM-Robot, `adapt_half_per_task` the robot ones and the human ones of WM-Mix, 200 and 100 as in
    the paper; `adapt_members` are the members of these models; `downstream_per_task` are the scenes
    of which two thirds have to suffice for them.
    """

    robot_per_task: int = Field(default=4, ge=2)
    multiples: tuple[int, ...] = (1, 5, 10)
    pretraining_per_task: int = Field(default=200, ge=2)
    heldout_per_task: int = Field(default=6, ge=1)
    downstream_per_task: int = Field(default=315, ge=3)
    adapt_robot_per_task: int = Field(default=200, ge=1)
    adapt_half_per_task: int = Field(default=100, ge=1)
    tokenizer_cpu_s: int = Field(default=60, ge=1)
    train_cpu_s: int = Field(default=300, ge=1)
    option_cpu_s: int = Field(default=120, ge=1)
    reader_steps: int = Field(default=600, ge=2)
    core_steps: int = Field(default=2000, ge=2)
    pretraining_reader_steps: int = Field(default=1000, ge=2)
    pretraining_core_steps: int = Field(default=1500, ge=2)
    adapt_reader_steps: int = Field(default=2000, ge=1)
    adapt_core_steps: int = Field(default=1500, ge=1)
    adapt_members: int = Field(default=1, ge=1)
    core_batch: int = Field(default=32, ge=1)
    drawing_cpu_s: int = Field(default=30, ge=1)
    policy_steps: int = Field(default=3000, ge=1)
    num_starts: int = Field(default=10, ge=1)
    num_generated: int = Field(default=100, ge=1)


QUICK: Final = Sizes(
    robot_per_task=8,
    multiples=(1,),
    pretraining_per_task=8,
    heldout_per_task=1,
    downstream_per_task=24,
    adapt_robot_per_task=2,
    adapt_half_per_task=1,
    tokenizer_cpu_s=3,
    train_cpu_s=6,
    option_cpu_s=4,
    reader_steps=4,
    core_steps=4,
    pretraining_reader_steps=4,
    pretraining_core_steps=4,
    adapt_reader_steps=2,
    adapt_core_steps=2,
    drawing_cpu_s=1,
    policy_steps=20,
    num_starts=1,
    num_generated=4,
)


@dataclass(frozen=True)
class Experiments:
    """Steps of all tables for some sizes and training seeds."""

    sizes: Sizes
    seeds: tuple[int, ...]

    def steps(self, tables: Sequence[Table]) -> list[Step]:
        """Steps of some tables, each once and after those that it needs."""
        makers = {
            "tokenizer": self._tokenizers,
            "options": lambda: self._joint_models("options", OPTIONS),
            "instruction": self._instructed,
            "design": lambda: self._joint_models("design", DESIGNS),
            "scaling": self._scaling,
            "evaluator": self._evaluator,
            "generation": self._generation,
        }
        found: dict[str, Step] = {}

        def add(step: Step) -> None:
            for need in step.needs:
                add(need)
            found.setdefault(step.name, step)

        for table in TABLES:
            for step in makers[table]() if table in tables else ():
                add(step)
        return list(found.values())

    @cached_property
    def _data(self) -> Mapping[str, Step]:
        """Recorded episodes by name."""
        sizes = self.sizes
        num_robot = sizes.robot_per_task * len(ROBOT_PRETRAINING)
        # Two more, of which alignment may refuse some; two thirds of the scenes have to suffice.
        human = 2 + max(sizes.multiples) * num_robot // len(HUMAN_PRETRAINING)
        # Of these, the splits B and C, about two thirds, are adapted on.
        downstream_human = 3 + 16 * sizes.adapt_half_per_task // 10
        # Demonstrations move all the time; the default mix has takes in which nothing does, whose
        # images any prediction gets right.
        moving = "--mix demonstrations"
        by_devices = "--domains human --path devices"
        amounts = {
            "robot": (sizes.robot_per_task, f"robot-pretraining {moving}"),
            "cans": (sizes.robot_per_task, f"{_CANS} --exact"),
            "pretraining": (sizes.pretraining_per_task, "robot-pretraining --images 4"),
            "human": (human, f"human-pretraining {by_devices} {moving}"),
            "downstream": (sizes.downstream_per_task, "downstream --images 4"),
            "downstream-human": (downstream_human, f"downstream {by_devices} --images 4"),
            "demonstrations": (sizes.downstream_per_task, "downstream --exact --images 8"),
        }
        for name in ("robot", "cans", "downstream"):
            heldout = f"{amounts[name][1]} --first {_FIRST_HELDOUT_SEED}"
            amounts[f"{name}-heldout"] = (sizes.heldout_per_task, heldout)
        return {
            name: step_with_result(
                f"data/{name}",
                f"train data --store data/{name}/store --tasks {words} --count {count} --jobs 1",
                "store",
                exits=(0, 1),
            )
            for name, (count, words) in amounts.items()
        }

    def _tokenizers(self) -> Iterator[Step]:
        for kind in TOKENIZERS.values():
            for seed in self.seeds:
                name, made = f"tokenizer/{kind}/seed-{seed}", "tokenizer.safetensors"
                yield step_with_result(
                    name,
                    f"train tokenizer --episodes data/robot/store --tokenizer {kind} --seed {seed} "
                    f"--cpu-budget-s {self.sizes.tokenizer_cpu_s} --output {name}/{made}",
                    made,
                    needs=(self._data["robot"],),
                )

    def _joint_models(self, table: Table, columns: Mapping[str, str]) -> Iterator[Step]:
        for column, flags in columns.items():
            for seed in self.seeds:
                model = self._world_model(f"{table}/{folder_of(column)}", seed, flags)
                is_base = column == BASES[table] and seed == self.seeds[0]
                yield self._predicted(model, (*(REFERENCES if is_base else ()), OTHER_ACTIONS))

    def _scaling(self) -> Iterator[Step]:
        """State models with more and more human data."""
        for seed in self.seeds:
            yield self._rolled_out(self._state_model("0", seed))
            for multiple in self.sizes.multiples:
                num_human = self._num_human(multiple)
                yield self._rolled_out(self._state_model(f"{multiple}x", seed, num_human))
        for seed in self.seeds:
            yield self._rolled_out(self._state_model(HALF_TRAINING, seed))

    def _num_human(self, multiple: int) -> int:
        return multiple * self.sizes.robot_per_task * len(ROBOT_PRETRAINING)

    def _state_model(self, column: str, seed: int, num_human: int = 0) -> Step:
        """One member of a state model, trained for as many steps in every column but one."""
        sizes, share = self.sizes, 2 if column == HALF_TRAINING else 1
        return self._pretrained(
            f"scaling/{folder_of(column)}/seed-{seed}/model",
            seed,
            steps=(sizes.reader_steps // share, sizes.core_steps // share),
            num_human=num_human,
        )

    def _pretrained(
        self,
        name: str,
        seed: int,
        *,
        steps: tuple[int, int],
        robot: str = "robot",
        num_human: int = 0,
        flags: str = "--num-members 1",
    ) -> Step:
        """A state model, with numbers of steps of its start reader and its core."""
        needs = [self._data[robot], self._data["robot-heldout"]]
        if num_human:
            needs.append(self._data["human"])
            flags += f" --human data/human/store --human-episodes {num_human}"
        return step_with_result(
            name,
            f"train world-model --episodes data/{robot}/store --heldout data/robot-heldout/store "
            f"{flags} --seed {seed} --jobs 1 "
            f"--reader.num-steps {steps[0]} "
            f"--core.num-steps {steps[1]} --core.batch {self.sizes.core_batch} "
            f"--drawing.cpu-budget-s {self.sizes.drawing_cpu_s} --output {name}/{_MODEL}",
            _MODEL,
            needs=tuple(needs),
        )

    def _world_model(self, column: str, seed: int, flags: str, data: str = "robot") -> Step:
        """A world model of the paper's form; `column` is the folder of a table's column."""
        name = f"{column}/seed-{seed}/model"
        is_option = column.startswith("options/")
        cpu_s = self.sizes.option_cpu_s if is_option else self.sizes.train_cpu_s
        return step_with_result(
            name,
            f"train world-model --preset tiny {flags} --episodes data/{data}/store "
            f"--heldout data/{data}-heldout/store --seed {seed} --cpu-budget-s {cpu_s} --resume "
            f"{_SHORT_EVALUATION} --output {name}/{_MODEL}",
            _MODEL,
            needs=(self._data[data], self._data[f"{data}-heldout"]),
        )

    def _rolled_out(self, model: Step, data: str = "robot") -> Step:
        """Errors of a state model over whole rollouts of held-out episodes."""
        return self._predicted(model, STATE_REFERENCES, data, "rollouts", _STATE_METRICS)

    def _predicted(
        self,
        model: Step,
        baselines: Sequence[str],
        data: str = "robot",
        horizon: str = "windows",
        metrics: str = "",
    ) -> Step:
        """Errors of a model's predictions on held-out episodes, beside those of baselines."""
        return step_with_result(
            f"{model.name.removesuffix('model')}prediction",
            f"evaluate prediction --checkpoint {model.name}/{_MODEL} --horizon {horizon} "
            f"--episodes data/{data}-heldout/store {metrics} --baselines {','.join(baselines)}",
            needs=(self._data[f"{data}-heldout"], model),
        )

    def _instructed(self) -> Iterator[Step]:
        """Models of the can tasks, which start alike, measured with right and wrong sentences."""
        for encoder, kind in INSTRUCTIONS.items():
            for seed in self.seeds:
                column = f"instruction/{folder_of(encoder)}"
                flags = f"--network.instruction-encoder {kind}"
                model = self._world_model(column, seed, flags, "cans")
                baselines = ("copy", "no_instruction", "other_instruction")
                yield self._predicted(model, baselines, "cans")

    def _adapted(self, world: str, seed: int) -> Step:
        """WM-Robot or WM-Mix, from one model of robot episodes with mistakes and all human ones."""
        sizes = self.sizes
        ancestor = self._pretrained(
            "evaluator/pretrained/model",
            self.seeds[0],
            steps=(sizes.pretraining_reader_steps, sizes.pretraining_core_steps),
            robot="pretraining",
            num_human=self._num_human(max(sizes.multiples)),
            flags="--num-members 1 --human-share 0.2",
        )
        num_robot = len(DOWNSTREAM) * sizes.adapt_robot_per_task
        num_half = len(DOWNSTREAM) * sizes.adapt_half_per_task
        flags = {
            "WM-Robot": f"--robot-episodes {num_robot}",
            "WM-Mix": f"--robot-episodes {num_half} --human-episodes {num_half} "
            "--human data/downstream-human/store",
        }
        stores = ["downstream", "downstream-heldout"]
        if world == "WM-Mix":
            stores.append("downstream-human")
        name = f"evaluator/{world}/seed-{seed}/model"
        return step_with_result(
            name,
            f"train adapt --init {ancestor.name}/{_MODEL} --episodes data/downstream/store "
            f"--splits B,C {flags[world]} --heldout data/downstream-heldout/store --seed {seed} "
            f"--num-members {sizes.adapt_members} --jobs 1 "
            f"--reader.num-steps {sizes.adapt_reader_steps} "
            f"--core.num-steps {sizes.adapt_core_steps} --core.batch {sizes.core_batch} "
            f"--drawing.cpu-budget-s {sizes.drawing_cpu_s} --output {name}/{_MODEL}",
            _MODEL,
            needs=(ancestor, *(self._data[name] for name in stores)),
        )

    def _judge(self, world: str, seed: int) -> Step:
        """The package's success classifier, calibrated for an adapted model."""
        model = self._adapted(world, seed)
        name = f"evaluator/{world}/seed-{seed}/imagined"
        chosen = f"--split {_UNSEEN_SPLIT} --jobs 1"
        imagined = step_with_result(
            name,
            f"train imagined --episodes data/downstream/store --store {name}/store {chosen} "
            f"--checkpoint {model.name}/{_MODEL}",
            "store",
            needs=(self._data["downstream"], model),
        )
        name = f"evaluator/{world}/seed-{seed}/judge"
        return step_with_result(
            name,
            f"train judge --base package --splits {_UNSEEN_SPLIT} "
            f"--episodes data/downstream/store,{imagined.name}/store --output {name}/{_JUDGE}",
            _JUDGE,
            needs=(imagined,),
        )

    def _evaluator(self) -> Iterator[Step]:
        """Adapted world models and their judges, and a study of policies in them and the twin."""
        named = [(world, seed) for world in ADAPTED for seed in self.seeds]
        worlds = {f"{world} {seed}": self._adapted(world, seed) for world, seed in named}
        judges = {f"{world} {seed}": self._judge(world, seed) for world, seed in named}
        for model in worlds.values():
            yield self._rolled_out(model, "downstream")
        cloned = step_with_result(
            "evaluator/policy",
            "train policy --episodes data/downstream/store --splits A,B --early-at 0.15 "
            f"--training.num-training-steps {self.sizes.policy_steps} "
            f"--output evaluator/policy/{_POLICY}",
            _POLICY,
            _EARLY_POLICY,
            needs=(self._data["downstream"],),
        )
        policies = {"cloned": _POLICY, "cloned early": _EARLY_POLICY}
        files = {name: f"{cloned.name}/{made}" for name, made in policies.items()}
        scripts = "".join(f'[policies."{name}"]\nscript = "{name}"\n' for name in SCRIPTS)
        needs = (cloned, *judges.values())
        lines = {
            world: f'checkpoint = "{model.name}/{_MODEL}"\nprobe = "{judges[world].name}/{_JUDGE}"'
            for world, model in worlds.items()
        }
        yield self._study("evaluator", lines, files, needs, scripts)

    def _generation(self) -> Iterator[Step]:
        """Policies from real and from generated demonstrations, and their study in the twin."""
        policies: dict[str, Step] = {}
        for seed in self.seeds:
            for column in GENERATED:
                is_generated = column.startswith("+")
                model = self._adapted(column[1:] if is_generated else "WM-Robot", seed)
                needs = [self._data["demonstrations"], model]
                flags = f"--splits {'A,B' if column == 'Real' else 'B'}"
                if is_generated:
                    needs.append(self._demonstrations(column, model, seed))
                    flags += f" --imagined {needs[-1].name}/store"
                name = f"generation/{column}/seed-{seed}/policy"
                policies[policy_of(column, seed)] = step_with_result(
                    name,
                    f"train policy --episodes data/demonstrations/store {flags} "
                    f"--places {model.name}/{_MODEL} --output {name}/{_POLICY}",
                    _POLICY,
                    needs=tuple(needs),
                )
        files = {name: f"{step.name}/{_POLICY}" for name, step in policies.items()}
        yield self._study("generation", {}, files, tuple(policies.values()))

    def _demonstrations(self, column: str, model: Step, seed: int) -> Step:
        name = f"generation/{column}/seed-{seed}/demonstrations"
        return step_with_result(
            name,
            f"generate --episodes data/demonstrations/store --split {_UNSEEN_SPLIT} "
            f"--store {name}/store --checkpoint {model.name}/{_MODEL} "
            f"--count {self.sizes.num_generated} --strips {name}/strips.html",
            "store",
            needs=(self._data["demonstrations"], model),
        )

    def _study(
        self,
        table: Table,
        worlds: Mapping[str, str],
        policies: Mapping[str, str],
        needs: tuple[Step, ...],
        more: str = "",
    ) -> Step:
        """Study of cloned policies, by the paths of their files, in the twin and in some worlds.

        `worlds` are the keys of imagined worlds in the study file, by name.
        """
        lines = [
            f'name = "{table}"',
            f"tasks = {json.dumps(DOWNSTREAM)}",
            f"first_seed = {_FIRST_STUDY_SEED}",
            f"num_starts = {self.sizes.num_starts}",
            "keep_rollouts = false",
        ]
        for world, keys in worlds.items():
            lines += [f'[imagined."{world}"]', keys]
        for policy, path in policies.items():
            lines += [f'[policies."{policy}"]', 'builtin = "behaviour-cloning"']
            lines += [f'checkpoint = "{path}"']
        name = f"{table}/study"
        return step_with_result(
            name,
            f"study run {name}/study.toml --folder {name}/results",
            needs=needs,
            inputs=(("study.toml", "\n".join([*lines, more])),),
        )


def policy_of(column: str, seed: int) -> str:
    """Name of the policy of a column in the study of generated data; names begin with a letter."""
    return f"{column.removeprefix('+')} {seed}"


def folder_of(column: str) -> str:
    """Name of the folder of a table's column."""
    return column.replace(",", "").replace(" ", "-")
