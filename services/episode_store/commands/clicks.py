"""Command `clicks`: where the objects of episodes are, by the clicks on their first images."""

import numpy as np

from dextouch.episodes import ClickedPoses, clicked_poses
from dextouch.geometry import transform_from_pose
from dextouch.schemas import EpisodeClicks, json_ready, load_object_clicks
from services.episode_store.commands.context import Context, Outcome, table


def clicks(context: Context) -> Outcome:
    """Check the clicks of a file and of the store, and list the places that they give.

    The result is a file of all of them.
    """
    given = load_object_clicks(context.options.clicks)
    names = sorted({*given.episodes, *context.store.list()})
    found = {name: given.episodes.get(name) or context.store.clicks(name) for name in names}
    episodes = {name: one for name, one in found.items() if one is not None}
    rows: list[tuple[str, ...]] = [("episode", "object", "x mm", "y mm", "heading", "± mm")]
    for name, one in episodes.items():
        is_lenient = name not in given.episodes
        about = context.store.open(name).attributes
        rows += _rows(name, one, clicked_poses(about, given, one, may_lack_headings=is_lenient))
    for line in table(rows):
        context.say(line)
    return json_ready(given.model_copy(update={"episodes": episodes})), 0


def _rows(name: str, clicked: EpisodeClicks, found: ClickedPoses) -> list[tuple[str, ...]]:
    rows = []
    for index, one in enumerate(found.objects):
        click = clicked.objects.get(one.name)
        if click is None or click.state != "seen":
            rows.append(
                (name, one.name, "not clicked" if click is None else click.state, *[""] * 3)
            )
        elif not found.known[index]:
            rows.append((name, one.name, "no heading", *[""] * 3))
        else:
            axis = one.click.heading
            T = transform_from_pose(found.poses[index])
            x, y = T[:2, "xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
            heading = f"{np.rad2deg(np.arctan2(y, x)):.0f}°"
            place = (f"{1e3 * value:.0f}" for value in found.poses[index, :2])
            heading = "symmetric" if one.click.symmetric else heading
            rows.append((name, one.name, *place, heading, f"{1e3 * found.sd_m[index]:.1f}"))
    return rows
