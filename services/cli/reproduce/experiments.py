"""Experiments of the paper in miniature: the data, models and studies of each table, as steps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

from services.cli.reproduce.sizes import Sizes
from services.cli.reproduce.steps import Step
from services.twin.tasks.registry import DOWNSTREAM

Table = Literal[
    "tokenizer", "options", "instruction", "design", "scaling", "evaluator", "generation"
]
TABLES: Final[tuple[Table, ...]] = get_args(Table)
_CROSS_ATTENTION: Final = (
    *("--network.action-conditioning", "cross_attention"),
    "--no-network.add-condition-to-tokens",
)
# Columns of the design ablation: the default model, with what the paper's columns change. Models
# as the preset `paper` has them learn nothing useful in minutes.
DESIGNS: Final[dict[str, tuple[str, ...]]] = {
    "V-only": (*_CROSS_ATTENTION, "--no-network.use-touch"),
    "Cross-Attn": _CROSS_ATTENTION,
    "Robot-only": (),
}
# Single options of the joint model, each changed from the default.
OPTIONS: Final[dict[str, tuple[str, ...]]] = {
    "default": (),
    "velocity": ("--network.prediction", "velocity", "--network.sampling-steps", "8"),
    "plain video": ("--network.video-target", "plain"),
    "plain touch": ("--network.tactile-target", "plain"),
    "contact or changing": ("--optimizer.touch-loss", "contact_or_changing"),
    "no pose raster": ("--no-network.use-pose-raster",),
    "all palm axes": ("--network.palm-channels", "240"),
    "no sum with tokens": ("--no-network.add-condition-to-tokens",),
    "cross-attention": _CROSS_ATTENTION,
    "no scene encoder": ("--no-network.use-scene-encoder",),
    "no touch": ("--no-network.use-touch",),
}
INSTRUCTIONS: Final = {"hashed words": "hashed_words", "subwords": "subwords"}
CANS: Final = ("lift_full_can", "lift_empty_can", "move_can_left", "move_can_right")
# Columns with which the others of their tables are compared, and steps that tables share.
BASES: Final[dict[Table, str]] = {
    "options": "default",
    "design": "Robot-only",
    "evaluator": "WM-Robot",
}
SHARED: Final[dict[Table, str]] = {"scaling": "design/Robot-only"}
# Predictions that hardly depend on the model, measured beside the first seed of these columns.
REFERENCES: Final = ("copy", "warp", "zero", "codec", "true_images")
# Windows of held-out episodes for the short measurement at the end of a training: every n-th.
_SHORT_EVALUATION: Final = ("--evaluation-stride", "40")
OTHER_ACTIONS: Final = "other_take"
INSTRUCTION_BASELINES: Final = ("copy", "no_instruction", "other_instruction")
TOKENIZERS: Final = {"Split-Hands": "split_hands", "Grid": "grid"}
FIRST_HELDOUT_SEED: Final = 60_000
FIRST_STUDY_SEED: Final = 70_000
ADAPTED: Final = ("WM-Robot", "WM-Mix")
GENERATED: Final = ("Real", "Half", *(f"+{world}" for world in ADAPTED))
# Stand-ins of the paper's three policies: a cloned one, the same early in training, and a script.
SCRIPT_POLICY: Final = "script 15 mm"
# Half of the windows of a model with human data are the robot's: without human data, it has seen
# as many of them after half the training.
HALF_TRAINING: Final = "0, half as long"


@dataclass(frozen=True)
class Experiments:
    """Steps of all tables for some sizes and training seeds."""

    sizes: Sizes
    seeds: tuple[int, ...]

    def steps(self, tables: Sequence[Table]) -> list[Step]:
        """Steps of some tables and of what they need, each once and in order."""
        found: dict[str, Step] = {}
        everything = {step.name: step for step in self._all()}

        def add(name: str) -> None:
            for one in everything[name].needs:
                add(one)
            found.setdefault(name, everything[name])

        wanted = (*tables, *(SHARED[table] for table in tables if table in SHARED))
        for name in everything:
            if name.startswith(tuple(f"{one}/" for one in wanted)):
                add(name)
        return [step for name, step in everything.items() if name in found]

    def _all(self) -> Iterator[Step]:
        yield from self._data()
        yield from self._tokenizers()
        for option, flags in OPTIONS.items():
            for seed in self.seeds:
                yield from self._world_model("options", option, seed, flags)
        for encoder, kind in INSTRUCTIONS.items():
            for seed in self.seeds:
                yield from self._instructed(encoder, kind, seed)
        for design, flags in DESIGNS.items():
            for seed in self.seeds:
                yield from self._world_model("design", design, seed, flags)
        yield from self._scaling()
        for seed in self.seeds:
            yield from self._adapted(seed)
        yield from self._policies()
        yield self._study()
        yield from self._generation()

    def _data(self) -> Iterator[Step]:
        sizes = self.sizes
        # Demonstrations move all the time; the default mix has takes in which nothing does, whose
        # images any prediction gets right.
        moving = ("--mix", "demonstrations")
        robot = ("--tasks", "robot-pretraining", *moving)
        human = ("--domains", "human", "--path", "devices")
        yield _data_step("data/robot", sizes.robot_per_task, robot)
        yield _data_step("data/heldout", sizes.heldout_per_task, robot, FIRST_HELDOUT_SEED)
        cans = ("--tasks", ",".join(CANS), "--exact")
        yield _data_step("data/cans", sizes.robot_per_task, cans)
        yield _data_step("data/cans-heldout", sizes.heldout_per_task, cans, FIRST_HELDOUT_SEED)
        yield _data_step(
            "data/human", sizes.human_per_task, ("--tasks", "human-pretraining", *human, *moving)
        )
        downstream = ("--tasks", "downstream")
        yield _data_step("data/downstream", sizes.downstream_per_task, downstream)
        per_task = sizes.downstream_human_per_task
        yield _data_step("data/downstream-human", per_task, (*downstream, *human))
        yield _data_step(
            "data/downstream-heldout", sizes.heldout_per_task, downstream, FIRST_HELDOUT_SEED
        )

    def _tokenizers(self) -> Iterator[Step]:
        for kind in TOKENIZERS.values():
            for seed in self.seeds:
                name = f"tokenizer/{kind}/seed-{seed}"
                words = (
                    *("train", "tokenizer", "--episodes", "data/robot/store"),
                    *("--tokenizer", kind, "--seed", str(seed)),
                    *("--cpu-budget-s", str(self.sizes.tokenizer_cpu_s)),
                    *("--output", f"{name}/tokenizer.safetensors", "--json", f"{name}/result.json"),
                )
                made = ("tokenizer.safetensors", "result.json")
                yield Step(name, words, made, ("data/robot",))

    def _scaling(self) -> Iterator[Step]:
        for seed in self.seeds:
            yield from self._world_model("scaling", HALF_TRAINING, seed)
        for multiple in self.sizes.multiples:
            count = str(multiple * self.sizes.num_robot)
            human = ("--human", "data/human/store", "--human-episodes", count)
            for seed in self.seeds:
                column = f"{multiple}x"
                yield from self._world_model("scaling", column, seed, human, ("data/human",))

    def _world_model(
        self,
        table: Table,
        column: str,
        seed: int,
        options: tuple[str, ...] = (),
        needs: tuple[str, ...] = (),
    ) -> Iterator[Step]:
        folder = f"{table}/{folder_of(column)}/seed-{seed}"
        name = f"{folder}/model"
        cpu_s = self.sizes.option_cpu_s if table == "options" else self.sizes.train_cpu_s
        if column == HALF_TRAINING:
            cpu_s = cpu_s // 2
        words = (
            *("train", "world-model", *options, "--episodes", "data/robot/store"),
            *("--heldout", "data/heldout/store", "--seed", str(seed)),
            *("--cpu-budget-s", str(cpu_s), "--resume", *_SHORT_EVALUATION),
            *("--output", f"{name}/model.safetensors", "--json", f"{name}/result.json"),
        )
        needed = ("data/robot", "data/heldout", *needs)
        yield Step(name, words, ("model.safetensors", "result.json"), needed)
        prediction = f"{folder}/prediction"
        yield _prediction_step(
            prediction, name, "data/heldout", self._references(table, column, seed)
        )

    def _references(self, table: Table, column: str, seed: int) -> Sequence[str]:
        is_base = column == BASES.get(table) and seed == self.seeds[0]
        return (*REFERENCES, OTHER_ACTIONS) if is_base else (OTHER_ACTIONS,)

    def _instructed(self, encoder: str, kind: str, seed: int) -> Iterator[Step]:
        """A model of the can tasks, which start alike, measured with right and wrong sentences."""
        folder = f"instruction/{folder_of(encoder)}/seed-{seed}"
        name = f"{folder}/model"
        words = (
            *("train", "world-model", "--network.instruction-encoder", kind),
            *("--episodes", "data/cans/store", "--heldout", "data/cans-heldout/store"),
            *("--seed", str(seed), "--cpu-budget-s", str(self.sizes.train_cpu_s), "--resume"),
            *_SHORT_EVALUATION,
            *("--output", f"{name}/model.safetensors", "--json", f"{name}/result.json"),
        )
        needs = ("data/cans", "data/cans-heldout")
        yield Step(name, words, ("model.safetensors", "result.json"), needs)
        heldout = "data/cans-heldout"
        yield _prediction_step(f"{folder}/prediction", name, heldout, INSTRUCTION_BASELINES)

    def _adapted(self, seed: int) -> Iterator[Step]:
        """WM-Robot and WM-Mix, from the model that saw the most human data."""
        sizes = self.sizes
        ancestor = f"scaling/{max(sizes.multiples)}x/seed-{seed}/model"
        amounts = {
            "WM-Robot": ("--robot-episodes", str(sizes.adapt_robot)),
            "WM-Mix": (
                *("--robot-episodes", str(sizes.adapt_half)),
                *("--human", "data/downstream-human/store"),
                *("--human-episodes", str(sizes.adapt_half)),
            ),
        }
        for world, options in amounts.items():
            name = f"evaluator/{world}/seed-{seed}/model"
            words = (
                *("train", "adapt", "--init", f"{ancestor}/model.safetensors"),
                # Scenes of split A are left for generation.
                *("--episodes", "data/downstream/store", "--splits", "B,C", *options),
                *("--heldout", "data/downstream-heldout/store", "--seed", str(seed)),
                *("--cpu-budget-s", str(sizes.adapt_cpu_s), *_SHORT_EVALUATION),
                *("--output", f"{name}/model.safetensors", "--json", f"{name}/result.json"),
            )
            needs = ("data/downstream", "data/downstream-human", "data/downstream-heldout")
            made = ("model.safetensors", "result.json")
            yield Step(name, words, made, (*needs, ancestor))
            prediction = f"evaluator/{world}/seed-{seed}/prediction"
            references = self._references("evaluator", world, seed)
            yield _prediction_step(prediction, name, "data/downstream-heldout", references)

    def _policies(self) -> Iterator[Step]:
        """Policies to evaluate: cloned from real demonstrations, and the same early in training."""
        yield self._policy("evaluator/policy", ("--splits", "A,B", "--early-at", "0.15"), ())

    def _policy(self, name: str, options: tuple[str, ...], needs: tuple[str, ...]) -> Step:
        words = (
            *("train", "policy", "--episodes", "data/downstream/store", *options),
            *("--training.num-training-steps", str(self.sizes.policy_steps)),
            *("--output", f"{name}/policy.safetensors", "--json", f"{name}/result.json"),
        )
        made = ["policy.safetensors", "result.json"]
        if "--early-at" in options:
            made.append("policy_early.safetensors")
        return Step(name, words, tuple(made), ("data/downstream", *needs))

    def _worlds(self) -> dict[str, str]:
        """Adapted world models by name in studies, with the step of each."""
        return {
            f"{world} {seed}": f"evaluator/{world}/seed-{seed}/model"
            for world in ADAPTED
            for seed in self.seeds
        }

    def _study(self) -> Step:
        """Study of the policies in the twin and in all adapted world models."""
        step = "evaluator/policy"
        files = {"cloned": f"{step}/policy.safetensors"}
        files["cloned early"] = f"{step}/policy_early.safetensors"
        script = f'[policies."{SCRIPT_POLICY}"]\nscript = "{SCRIPT_POLICY}"\n'
        needs = (step, *self._worlds().values())
        return self._study_step("evaluator", files, self._worlds(), needs, script)

    def _study_step(
        self,
        table: Table,
        policies: dict[str, str],
        worlds: dict[str, str],
        needs: tuple[str, ...],
        more: str = "",
    ) -> Step:
        name = f"{table}/study"
        tasks = ", ".join(f'"{task}"' for task in DOWNSTREAM)
        lines = [
            f'name = "{table}"',
            f"tasks = [{tasks}]",
            f"first_seed = {FIRST_STUDY_SEED}",
            f"num_starts = {self.sizes.num_starts}",
            "keep_rollouts = false",
        ]
        for world, step in worlds.items():
            lines += [f'[imagined."{world}"]', f'checkpoint = "{step}/model.safetensors"']
        for policy, path in policies.items():
            lines += [f'[policies."{policy}"]', 'builtin = "behaviour-cloning"']
            lines += [f'checkpoint = "{path}"']
        words = (
            *("study", "run", f"{name}/study.toml", "--folder", f"{name}/results"),
            *("--json", f"{name}/result.json"),
        )
        inputs = (("study.toml", "\n".join([*lines, more])),)
        return Step(name, words, ("result.json",), needs, inputs)

    def _generation(self) -> Iterator[Step]:
        """Policies from real and from generated demonstrations, and their study in the twin."""
        policies: dict[str, str] = {}
        for seed in self.seeds:
            options: dict[str, tuple[str, ...]] = {
                "Real": ("--splits", "A,B"),
                "Half": ("--splits", "B"),
            }
            needs: dict[str, tuple[str, ...]] = {}
            for world in ADAPTED:
                demonstrations = self._demonstrations(world, seed)
                yield demonstrations
                store = f"{demonstrations.name}/store"
                options[f"+{world}"] = ("--splits", "B", "--imagined", store)
                needs[f"+{world}"] = (demonstrations.name,)
            for column, words in options.items():
                name = f"generation/{column}/seed-{seed}/policy"
                seeded = (*words, "--training.seed", str(seed))
                yield self._policy(name, seeded, needs.get(column, ()))
                policies[policy_of(column, seed)] = name
        files = {policy: f"{name}/policy.safetensors" for policy, name in policies.items()}
        yield self._study_step("generation", files, {}, tuple(policies.values()))

    def _demonstrations(self, world: str, seed: int) -> Step:
        model = f"evaluator/{world}/seed-{seed}/model"
        name = f"generation/+{world}/seed-{seed}/demonstrations"
        words = (
            *("generate", "--episodes", "data/downstream/store", "--split", "A"),
            *("--checkpoint", f"{model}/model.safetensors", "--store", f"{name}/store"),
            *("--count", str(self.sizes.num_generated), "--strips", f"{name}/strips.html"),
            *("--json", f"{name}/result.json"),
        )
        return Step(name, words, ("store", "result.json"), ("data/downstream", model))


def policy_of(column: str, seed: int) -> str:
    """Name of the policy of a column in the study of generated data; names begin with a letter."""
    return f"{column.removeprefix('+')} {seed}"


def folder_of(column: str) -> str:
    """Name of the folder of a table's column."""
    return column.replace(",", "").replace(" ", "-")


def _data_step(name: str, count: int, options: tuple[str, ...], first: int = 0) -> Step:
    words = (
        *("train", "data", "--store", f"{name}/store", *options, "--first", str(first)),
        *("--count", str(count), "--jobs", "1", "--json", f"{name}/result.json"),
    )
    return Step(name, words, ("store", "result.json"), exits=(0, 1))


def _prediction_step(name: str, model: str, heldout: str, baselines: Sequence[str]) -> Step:
    words = (
        *("evaluate", "prediction", "--checkpoint", f"{model}/model.safetensors"),
        *("--episodes", f"{heldout}/store", "--horizon", "windows"),
        *("--baselines", ",".join(baselines)),
        *("--json", f"{name}/result.json"),
    )
    return Step(name, words, ("result.json",), (heldout, model))
