"""Runs a rollout and lists episodes with generated clients alone; knows nothing of dextouch."""

import base64
import struct
import sys
from io import BytesIO

from episode_store import AuthenticatedClient as StoreClient
from episode_store.api.episodes import get_episode, list_episodes
from worlds import AuthenticatedClient as WorldClient
from worlds.api.rollouts import delete_rollout, get_rollout, list_worlds, send_chunk, start_rollout
from worlds.models import (
    ActionsBody,
    Problem,
    SendChunkSteps,
    StartRequest,
)
from worlds.types import File

NUM_ROWS, NUM_COLUMNS = 4, 67


def roll_out(url: str, key: str) -> None:
    """Start a rollout, send chunks as JSON and as bytes, and read what was reached."""
    headers = {"Accept": "application/json"}
    client = WorldClient(base_url=url, token=key, headers=headers)
    (world,) = list_worlds.sync(client=client).worlds
    request = StartRequest(world=world.name, task=world.tasks[0], seed=3, instruction="do it")
    started = start_rollout.sync(client=client, body=request)
    rollout_id = started.fields.rollout.id
    rows = [[0.0] * NUM_COLUMNS for _ in range(NUM_ROWS)]
    rows[-1][11] = 0.25
    chunks = [
        ActionsBody(actions=rows),
        File(BytesIO(b"".join(struct.pack("<67d", *row) for row in rows))),
    ]
    for number, chunk in enumerate(chunks):
        answer = send_chunk.sync(
            rollout_id, number, client=client, body=chunk, steps=SendChunkSteps.LAST
        )
        assert answer.fields.rollout.next_chunk == number + 1, answer
        reached = answer.arrays["action_reached"]
        assert (reached.dtype, reached.shape) == ("float64", [1, NUM_COLUMNS]), reached
        values = struct.unpack("<67d", base64.b64decode(reached.data))
        assert values[11] == 0.25, values
    refused = send_chunk.sync(rollout_id, 7, client=client, body=ActionsBody(actions=rows))
    assert isinstance(refused, Problem), refused
    assert (refused.status, refused.details["expected"]) == (409, 2), refused
    assert get_rollout.sync(rollout_id, client=client).last_step == 2 * NUM_ROWS
    assert delete_rollout.sync_detailed(rollout_id, client=client).status_code == 204


def list_all(url: str, key: str) -> None:
    """List the episodes of a store, and read what is known of each."""
    client = StoreClient(base_url=url, token=key)
    listed = list_episodes.sync(client=client)
    assert listed.num_matching == len(listed.episodes) == 1, listed
    (episode,) = listed.episodes
    detail = get_episode.sync(episode.episode_id, client=client)
    assert detail.num_steps > 0, detail
    assert detail.attributes.task == "reach", detail


if __name__ == "__main__":
    world_url, store_url, api_key = sys.argv[1:]
    roll_out(world_url, api_key)
    list_all(store_url, api_key)
