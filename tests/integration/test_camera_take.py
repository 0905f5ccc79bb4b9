"""Images → mock camera → driver → recorder → spool → store → images: every one of them is there."""

import asyncio
import threading
from contextlib import closing

import httpx
import numpy as np
import pytest

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader, SpoolWriter
from dextouch.images import decode_jpeg
from dextouch.schemas import RecordingAttributes, SaveTake, TakePrompt
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.replay import MockSlot, ReplayStream
from services.acquisition.mocks.trackers_and_cameras import video_camera
from services.acquisition.settings import MockLinks, SpoolSafety
from services.acquisition.station import Station
from services.acquisition.take import Take, TakeWatch
from services.acquisition.uploader import Uploader
from services.alignment.synchronization.stream_clock import time_stream
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
SIZE_PX = (96, 128)
DELAY_MS = 12.0
EXPOSURE_NS = 8_000_000


class InProcess(httpx.BaseTransport):
    """Hands requests of a synchronous client to an application."""

    def __init__(self, app):
        self.app = app

    def handle_request(self, request):
        async def answer():
            transport = httpx.ASGITransport(app=self.app)
            async with httpx.AsyncClient(transport=transport) as client:
                body = request.read()
                forwarded = httpx.Request(
                    request.method, request.url, headers=request.headers, content=body
                )
                return await client.send(forwarded)

        answered = asyncio.run(answer())
        return httpx.Response(
            answered.status_code, headers=answered.headers, content=answered.content
        )


def scene(count):
    """A ball over a textured table, with a sensor's noise."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[0 : SIZE_PX[0], 0 : SIZE_PX[1]]
    table = 110 + 30 * np.sin(rows / 6) * np.cos(columns / 9)
    images = np.empty((count, *SIZE_PX, 3), np.uint8)
    for index in range(count):
        ball = np.hypot(rows - 48 - 20 * np.sin(index / 9), columns - 64 - index % 40) < 14
        picture = np.where(ball, 200, table)[..., None] + rng.normal(0, 2, (*SIZE_PX, 3))
        images[index] = np.clip(picture, 0, 255)
    return images


def replay(count):
    descriptor = StreamDescriptor(
        name="camera_head",
        kind="image",
        shape=(*SIZE_PX, 3),
        dtype="uint8",
        unit="rgb8",
        nominal_rate_hz=30.0,
    )
    t_ns = np.round(np.arange(count) * 1e9 / 30).astype(np.int64)
    return ReplayStream(descriptor, t_ns, scene(count))


def record(stream, encoding, spool_root, **faults):
    """One take of one camera on the station; the driver, and what the mock did."""
    clock = VirtualClock()
    disturbed = DeviceFaults(path_delay_ms=DELAY_MS, **faults)
    pair = video_camera(
        MockSlot("camera_head", stream, disturbed, 3, clock),
        encoding=encoding,
        latency_ms=12.0,
        latency_sigma_ms=0.5,
    )
    pair.device.port.exposure_ns = EXPOSURE_NS
    station = Station(
        name="desk",
        drivers=[pair.driver],
        spool_root=spool_root,
        clock=clock,
        calibration=pair.driver.calibration(),
    )
    pair.device.port.plug()
    station.start()
    station.wait_connected()
    station.recorder.arm(PROMPT)
    station.recorder.record("take")
    start_ns = clock.now_ns() + 20_000_000
    waiter = clock.waiter(drives_time=True)

    def play():
        with closing(waiter):
            pair.device.play(clock, waiter, start_host_ns=start_ns)

    player = threading.Thread(target=play)
    player.start()
    player.join()
    pair.device.port.link.wait_consumed()
    station.recorder.stop()
    station.recorder.save(SaveTake(accept_incomplete=True))
    station.stop()
    return pair, SpoolReader(spool_root / "take")


def upload(spool_root, tmp_path):
    """The take as the store gives it back."""
    settings = EpisodeStoreSettings(
        store_url=str(tmp_path / "store"), sync_uploads=False, commit_in_process=False
    )
    with EpisodeStoreClient(
        "http://localhost", transport=InProcess(create_app(settings))
    ) as client:
        uploader = Uploader(spool_root, client, period_s=1.0)
        assert uploader.upload_all() == ["take"], uploader.status()
    return EpisodeStore(settings.store_url).recording("take")


def psnr_db(images, truth):
    error = np.mean((images.astype(np.float64) - truth) ** 2, axis=(1, 2, 3))
    return 10 * np.log10(255**2 / np.maximum(error, 1e-9))


@pytest.mark.parametrize("encoding", ["rgb8", "jpeg", "h264"])
def test_every_image_of_a_take_is_in_the_store(encoding, tmp_path):
    stream = replay(45)
    pair, spool = record(stream, encoding, tmp_path / "spool")
    assert spool.streams["camera_head"].unit == encoding
    recording = upload(tmp_path / "spool", tmp_path)
    batch = recording.read("camera_head")
    assert batch.sequence.tolist() == list(range(45))
    assert psnr_db(batch.values, stream.values).min() >= 30
    true_ns = np.array(pair.device.ledger.t_true_ns)
    np.testing.assert_array_equal(batch.t_device_ns, true_ns + EXPOSURE_NS // 2)
    np.testing.assert_array_equal(batch.t_host_ns, true_ns + 12_000_000)
    assert recording.attributes.calibration == {
        "camera_head_exposure_ns": ((float(EXPOSURE_NS),),),
        "camera_head_latency_ns": ((12e6,),),
        "camera_head_latency_sigma_ns": ((5e5,),),
    }
    assert recording.attributes.ledger == ()


def test_aligned_times_are_those_of_the_true_images(tmp_path):
    pair, spool = record(replay(90), "jpeg", tmp_path / "spool", jitter_ms=3.0)
    batch = spool.read("camera_head")
    timed = time_stream(batch, spool.streams["camera_head"], latency_ns=12_000_000)
    true_ns = np.array(pair.device.ledger.t_true_ns)
    error_ns = timed.t_host_ns - true_ns
    late_ns = batch.t_host_ns - true_ns - 12_000_000
    assert np.sqrt(np.mean(error_ns**2.0)) < 0.1 * np.sqrt(np.mean(late_ns**2.0))


def test_lost_images_and_an_unplugged_camera_leave_gaps_and_whole_groups(tmp_path):
    stream = replay(90)
    pair, spool = record(
        stream,
        "h264",
        tmp_path / "spool",
        drop_probability=0.1,
        unplugged_s=((1.0, 1.5),),
    )
    ledger = pair.device.ledger
    sent = [s for s, fate in zip(ledger.sequence, ledger.fate, strict=True) if fate == "sent"]
    assert len(sent) < 75
    batch = upload(tmp_path / "spool", tmp_path).read("camera_head")
    # The driver counts from its first image on.
    assert (batch.sequence + sent[0]).tolist() == sent
    assert psnr_db(batch.values, stream.values[sent]).min() >= 30
    entries = {entry.event: entry.count for entry in spool.attributes.ledger}
    assert entries["lost"] == sent[-1] - sent[0] + 1 - len(sent)


def test_a_take_of_a_running_camera_begins_with_a_group(tmp_path):
    """What a recorder does with `begin_take` and its takes."""
    clock = VirtualClock()
    stream = replay(45)
    place = MockSlot("camera_head", stream, DeviceFaults(), 3, clock)
    pair = video_camera(place, encoding="h264")
    driver, port = pair.driver, pair.device.port
    port.plug()
    driver.open()
    attributes = RecordingAttributes(
        recording_id="take",
        task="stack_bowls",
        instruction="",
        domain="human",
        station="desk",
        streams=driver.descriptors,
    )
    with SpoolWriter(tmp_path / "spool" / "take", attributes, sync=False) as spool:
        watch = TakeWatch({driver.name: driver}, clock)
        take = Take(spool, watch, clock=clock, safety=SpoolSafety())
        for index in range(45):
            if index == 13:
                assert driver.begin_take() == driver.calibration()
            (unit,) = pair.device.source.units(index, index, clock.now_ns() + index)
            assert port.send(unit)
            samples = driver.read()["camera_head"]
            if index >= 11:
                # The take began at 11, the camera heard of it at 13.
                take.accept({"camera_head": samples})
        take.end()
    driver.close()
    batch = upload(tmp_path / "spool", tmp_path).read("camera_head")
    assert len(batch) == 32
    assert psnr_db(batch.values, stream.values[13:]).min() >= 30


def test_a_bridge_that_sends_h264_reaches_the_store_in_whole_groups(tmp_path):
    faults = FaultScript(others=DeviceFaults(drop_probability=0.04))
    stream = replay(96)
    station = MockStation(
        [stream],
        faults,
        2,
        VirtualClock(),
        spool_root=tmp_path / "spool",
        links=MockLinks(images="h264"),
    )
    with station:
        take = station.run_take(PROMPT, recording_id="take")
    fates = np.array(take.ledger.of("camera_head").fate).reshape(12, 8)
    whole = np.flatnonzero((fates == "sent").all(axis=1))
    assert 0 < len(whole) < 12
    batch = upload(tmp_path / "spool", tmp_path).read("camera_head")
    assert batch.sequence.tolist() == [8 * g + k for g in whole for k in range(8)]
    assert psnr_db(batch.values, stream.values[batch.sequence]).min() >= 30


def test_jpeg_bytes_of_the_spool_are_the_images(tmp_path):
    stream = replay(6)
    _, spool = record(stream, "jpeg", tmp_path / "spool")
    images = np.stack([decode_jpeg(data) for data in spool.read("camera_head").values])
    assert psnr_db(images, stream.values).min() >= 35
