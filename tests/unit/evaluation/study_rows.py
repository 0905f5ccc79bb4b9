"""A study whose rows are written by hand, and what they must give, counted by plain loops."""

import json
import math

from scipy import stats

UNRELIABLE = "the world flags its prediction: two predictions are <b>14 mm</b> apart"
TASKS = ("stand_bottle", "open_drawer")
FIRST_SEED, NUM_STARTS = 500, 8
# Outcomes from the starts in order: S success, F failure, D success that the probe leaves open and
# that counts in no rate, X failed to run, . no result yet.
ROWS = {
    "stand_bottle": {
        "careful": {"real": "SSSSSSSF", "model": "SSSSSSFF", "blurred": "SSFFSSFF"},
        "clumsy": {"real": "SFFSFFFF", "model": "SFSSFFFF", "blurred": "SSSSSSSS"},
        "hold": {"real": "FFFFFFFF", "model": "FFFDFFFF", "blurred": "FFFFFFSS"},
    },
    "open_drawer": {
        "careful": {"real": "SSSSSSSS", "model": "SSSSSSDS", "blurred": "SFSFSFSF"},
        "clumsy": {"real": "SSSSFFFF", "model": "SSSSSFFF", "blurred": "FFFFFFFF"},
        "hold": {"real": "FFFFFFXF", "model": "FFFFFFFF", "blurred": "FF.FFFFF"},
    },
}
WORLDS = ("real", "model", "blurred")
DEFINITION = {
    "name": "touch and sight",
    "tasks": TASKS,
    "first_seed": FIRST_SEED,
    "num_starts": NUM_STARTS,
    "imagined": {"model": {"builtin": "world-model"}, "blurred": {"checkpoint": "b.safetensors"}},
    "policies": {name: {"script": "hold"} for name in ROWS[TASKS[0]]},
}


def lines(*, unfinished=()):
    """Lines of the results file; worlds named in `unfinished` have none yet."""
    yield json.dumps({"name": DEFINITION["name"], "definition": DEFINITION, "digests": {"d": "1"}})
    for task, policies in ROWS.items():
        for policy, worlds in policies.items():
            for world, outcomes in worlds.items():
                for index, letter in enumerate(outcomes):
                    if letter != "." and world not in unfinished:
                        yield json.dumps(row(world, policy, task, FIRST_SEED + index, letter))


def row(world, policy, task, seed, letter):
    place = {"world": world, "policy": policy, "task": task, "seed": seed}
    if letter == "X":
        return place | {"error": "UnavailableError", "message": "no answer", "traceback": None}
    unreliable = UNRELIABLE if letter == "D" else None
    success = letter in "SD"
    return place | {
        "start_digest": f"{task} {seed}",
        "success": success,
        "probability": 0.55 if unreliable else 0.9 if success else 0.1,
        "cannot_tell": unreliable,
        "repeat": 0,
    }


def write_study(folder, **options):
    folder.mkdir(parents=True)
    text = "".join(line + "\n" for line in lines(**options))
    (folder / "results.jsonl").write_text(text, encoding="utf-8")
    return folder / "results.jsonl"


def counted(task, policy, world):
    """Successes and decided rollouts."""
    outcomes = [letter for letter in ROWS[task][policy][world] if letter in "SF"]
    return outcomes.count("S"), len(outcomes)


def interval(task, policy, world):
    """Wilson's interval by scipy."""
    successes, trials = counted(task, policy, world)
    found = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return found.low, found.high


def matched_rates(task, world):
    """Rates of each policy in both worlds, over the starts that ended for all policies in both.

    Those of a world are of the decided rollouts among them.
    """
    policies = ROWS[task]
    starts = [
        index
        for index in range(NUM_STARTS)
        if all(
            policies[policy][side][index] in "SDF"
            for policy in policies
            for side in ("real", world)
        )
    ]
    letters = [
        [[policies[policy][side][i] for i in starts] for policy in policies]
        for side in ("real", world)
    ]
    return [[one.count("S") / (len(one) - one.count("D")) for one in side] for side in letters]


def pearson(task, world):
    return stats.pearsonr(*matched_rates(task, world)).statistic


def kendall(task, world):
    return stats.kendalltau(*matched_rates(task, world)).statistic


def mmrv(task, world):
    """Li et al. 2024 by two loops, with the ties of SimplerEnv."""
    real, imagined = matched_rates(task, world)
    worst = []
    for i in range(len(real)):
        largest = 0.0
        for j in range(len(real)):
            if (imagined[i] > imagined[j]) != (real[i] > real[j]):
                largest = max(largest, abs(real[i] - real[j]))
        worst.append(largest)
    return math.fsum(worst) / len(worst)


def disagreements():
    """Places where a finished rollout has another outcome than the real one."""
    return [
        (world, task, policy, FIRST_SEED + index)
        for task, policies in ROWS.items()
        for policy, worlds in policies.items()
        for world in WORLDS[1:]
        for index in range(NUM_STARTS)
        if worlds["real"][index] in "SDF"
        and worlds[world][index] in "SDF"
        and (worlds["real"][index] in "SD") != (worlds[world][index] in "SD")
    ]
