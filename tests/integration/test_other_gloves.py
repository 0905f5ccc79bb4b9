"""A glove of another layout: its packets, recording, episode and windows hold its own taxels."""

import json

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeStore, decode_window, encode_window
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError
from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams
from services.acquisition.routes import station_overview
from services.acquisition.settings import MockLinks
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.episode_store.reading import _played
from services.world_model.dynamics.features import TouchCodec
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.tactile import build_tokenizer
from tests.unit.other_gloves import small_layout

PROMPT = TakePrompt(task="stack-bowls", instruction="stack the bowls")
ROUND_S = 2.0
# What a float32 in newtons, and a whole count of 1 part in 4095, leave of 30 kPa.
ERROR_KPA = {"justfloat_glove": 1e-4, "tactile_glove": 0.02}


def recorded(store, gloves, layout, tmp_path):
    """A take of the pattern by gloves of a layout; its streams as they were played."""
    streams = pattern_streams(ROUND_S, layout=layout)
    with MockStation(
        streams,
        FaultScript(),
        1,
        VirtualClock(),
        spool_root=tmp_path / "spool",
        calibration=pattern_calibration(),
        links=MockLinks(gloves=gloves),
    ) as station:
        take = station.run_take(PROMPT, recording_id="take")
        overview = station_overview(station.station).model_dump(mode="json")
    # What the dashboard draws live hands by.
    text = layout.model_dump_json()
    assert overview["layouts"] == {"left": text, "right": text}
    spool = SpoolReader(take.spool_path)
    attributes = spool.attributes.model_copy(update={"streams": ()})
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, stream in spool.streams.items():
            batch = spool.read(name)
            writer.add_stream(stream)
            writer.append(
                name,
                values=batch.values,
                t_host_ns=batch.t_host_ns,
                t_device_ns=batch.t_device_ns,
                sequence=batch.sequence,
            )
    return take, {stream.descriptor.name: stream for stream in streams}


@pytest.mark.parametrize(
    ("gloves", "unit", "full_scale"),
    [("justfloat_glove", "N", 4.0), ("tactile_glove", "counts", 4095.0)],
)
def test_taxels_of_another_layout_arrive_in_windows(gloves, unit, full_scale, tmp_path):
    layout, store = small_layout(unit=unit, full_scale=full_scale), EpisodeStore(tmp_path / "store")
    take, played = recorded(store, gloves, layout, tmp_path)
    assert not [p for p in take.check.problems if p.level == "ERROR"]
    recording = store.recording("take")
    assert recording.streams["tactile_left"].shape == (150,)
    assert recording.streams["tactile_left"].layout == layout
    assert recording.streams["tactile_left"].nominal_rate_hz == 50
    report = align_recording(store, "take", AlignmentOptions(min_num_steps=8))
    episode = store.open(report.episode_id)
    assert episode.streams["tactile_right"].shape == (138,)
    assert episode.tactile_layout == layout
    shift_ns = report.quality["origin_after_start_ns"] - (
        take.ledger.start_host_ns - recording.attributes.started_t_host_ns
    )
    for side in ("left", "right"):
        data, true = episode.read(f"tactile_{side}"), played[f"tactile_{side}"]
        index = np.rint((data.t_ref_ns + shift_ns) * 50e-9).astype(int)
        inside = (index >= 0) & (index < len(true.values))
        assert inside.sum() > 50
        error_kpa = np.abs(data.values[inside] - true.values[index[inside]])
        assert error_kpa.max() <= ERROR_KPA[gloves]
    window = episode.window(0, 8)
    assert window.tactile_kpa.shape == (8, 2, 138)
    assert window.tactile_kpa.max() > 10
    assert window.taxels_measured.shape == (2, 138)
    again = decode_window(encode_window(window), max_bytes=1 << 24)
    assert again.tactile_layout == layout
    np.testing.assert_array_equal(again.tactile_kpa, window.tactile_kpa)
    # What the player draws recordings and episodes by.
    for reader, size in ((recording, 150), (episode, 138)):
        shown = _played(reader, reader.streams["tactile_left"]).model_dump(mode="json")
        assert shown["layout"] == json.loads(layout.model_dump_json())
        assert (shown["shape"], shown["unmeasured_taxels"]) == ([size], [])
    # Touch codecs of both forms of world model, fitted to what the gloves felt.
    touch = torch.from_numpy(window.tactile_kpa.copy())
    codec = TouchCodec(96, layout.num_taxels)
    codec.fit(touch.flatten(0, 1))
    torch.testing.assert_close(codec.decode(codec.encode(touch)), touch, atol=0.01, rtol=0.001)
    tokenizer = build_tokenizer(NetworkConfig(palm_channels=63).with_layout(layout))
    tokenizer.fit(touch)
    torch.testing.assert_close(
        tokenizer.decode(tokenizer.encode(touch)), touch, atol=0.01, rtol=0.001
    )


def test_hands_of_two_layouts_are_refused_by_name(tmp_path):
    store, layout = EpisodeStore(tmp_path / "store"), small_layout()
    recorded(store, "justfloat_glove", layout, tmp_path)
    recording = store.recording("take")
    other = layout.model_copy(update={"name": "other"})
    streams = tuple(
        one.model_copy(update={"layout": other}) if one.name == "tactile_right" else one
        for one in recording.streams.values()
    )
    attributes = recording.attributes.model_copy(update={"recording_id": "mixed", "streams": ()})
    with store.writer(kind="recording", attributes=attributes) as writer:
        for stream in streams:
            writer.add_stream(stream)
            batch = recording.read(stream.name)
            writer.append(
                stream.name,
                values=batch.values,
                t_host_ns=batch.t_host_ns,
                t_device_ns=batch.t_device_ns,
                sequence=batch.sequence,
            )
    with pytest.raises(InvalidInputError, match=r"'mixed': got tactile layouts 'small'.*'other'"):
        align_recording(store, "mixed", AlignmentOptions(min_num_steps=8))
