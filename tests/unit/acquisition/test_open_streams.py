"""Streams beyond the usual ones: gloves of other makers live, other trackers, a fourth camera."""

import numpy as np
import pytest
from pydantic import ValidationError

from dextouch.errors import DeviceError, InvalidInputError, NotFoundError
from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.devices import (
    CellLayout,
    Decoder,
    DecoderStatistics,
    Driver,
    build_drivers,
)
from services.acquisition.devices.pose_tracker import MAGIC, PAYLOAD, PoseTrackerDecoder
from services.acquisition.drivers.base import DATA_REPORT, split_into_reports
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.health.glove_records import is_ours
from services.acquisition.settings import AcquisitionSettings
from services.acquisition.station import LiveView
from services.acquisition.transports import SerialTransport, tcp_transport

IDS = {"vendor_id": 1, "product_id": 2}


class SmallGlove(Decoder):
    """A decoder of four cells in a row, which nothing feeds."""

    statistics = DecoderStatistics()
    cells = CellLayout(1000.0, grid=(1, 4))
    descriptors = (
        StreamDescriptor(
            name="tactile_left",
            kind="tactile",
            shape=(4,),
            dtype="uint16",
            unit="counts",
            nominal_rate_hz=50,
            side="left",
            device="glove_left",
        ),
    )

    def reset(self):
        pass

    def decode(self, data, t_host_ns):
        return {}


@pytest.fixture
def small_glove():
    return Driver(
        "glove_left",
        transport=SerialTransport(lambda: ""),
        decoder=SmallGlove(),
        clock=StationClock(),
    )


def calibration(cells):
    return {
        "tactile_left_tare_counts": ((100.0, 110.0, 120.0, 130.0),),
        "tactile_left_gain_counts_per_kpa": ((10.0, 20.0, 40.0, 50.0),),
        "tactile_left_cells": (tuple(map(float, cells)),),
    }


def test_pressures_of_another_makers_glove_are_shown_by_its_calibration(small_glove):
    cells = np.full(320, -1)
    cells[[7, 80, 319]] = [2, 0, 3]
    view = LiveView([small_glove], calibration(cells))
    counts = np.array([150, 999, 200, 30], dtype="<u2")
    view.accept({"tactile_left": [Sample(1_000, counts)]})
    (pressures,) = view.pressures_kpa(2_000).values()
    # By hand: (200 - 120) / 40, (150 - 100) / 10, and (30 - 130) / 50 is below zero.
    expected = np.zeros(320)
    expected[[7, 80, 319]] = [2.0, 5.0, 0.0]
    np.testing.assert_allclose(pressures, expected, rtol=1e-6)
    # The judge of our own gloves' 360 cells has nothing to do with it.
    assert not is_ours(small_glove.descriptors[0])


def test_a_calibration_of_another_glove_is_refused(small_glove):
    with pytest.raises(
        InvalidInputError, match=r"got 4 for taxel 0, expected a whole number -1 … 3"
    ):
        LiveView([small_glove], calibration([4, *[-1] * 319]))
    with pytest.raises(NotFoundError, match="got 2 numbers, expected 320"):
        LiveView([small_glove], calibration([0, 1]))
    incomplete = calibration([0] * 320)
    del incomplete["tactile_left_cells"]
    assert LiveView([small_glove], incomplete)._gloves == {}


def test_other_places_and_cameras_are_settings():
    devices = [
        {"kind": "pose_tracker", "stream": "elbow_left", **IDS},
        {"kind": "pose_tracker", "stream": "object_cup", "link": "bridge", "port": 1},
        {"kind": "camera", "stream": "camera_table", "port": 2},
        {"kind": "station_camera", "stream": "camera_ceiling", "serial_number": "C4"},
    ]
    drivers = build_drivers(AcquisitionSettings(devices=devices).devices, StationClock())
    found = [(d.name, d.descriptors[0].name, d.descriptors[0].side) for d in drivers]
    assert found == [
        ("pose_tracker_elbow_left", "elbow_left", "left"),
        ("pose_tracker_object_cup", "object_cup", None),
        ("camera_table", "camera_table", None),
        ("camera_ceiling", "camera_ceiling", None),
    ]


def test_eight_gloves_are_told_apart_by_labels():
    form = {"num_values": 64, "full_scale": 1.0, "rate_hz": 50}
    kinds = {"tactile_glove": {}, "wuji_glove": {}, "justfloat_glove": form}
    gloves = [(kind, side) for kind in kinds for side in ("left", "right")]
    devices = [
        {"kind": "tactile_glove", "side": side, "serial_number": side} for side in ("left", "right")
    ]
    devices += [
        {"kind": kind, "side": side, "label": kind, "port": f"/dev/{kind}_{side}", **kinds[kind]}
        for kind, side in gloves
    ]
    drivers = build_drivers(AcquisitionSettings(devices=devices).devices, StationClock())
    assert [driver.name for driver in drivers] == [
        "glove_left",
        "glove_right",
        *(f"glove_{side}_{kind}" for kind, side in gloves),
    ]
    for driver in drivers:
        (stream,) = driver.descriptors
        assert stream.name == driver.name.replace("glove", "tactile", 1)
        assert (stream.device, stream.side) == (driver.name, driver.name.split("_")[1])


@pytest.mark.parametrize(
    "device",
    [
        {"kind": "tactile_glove", "side": "left", "port": "p", "label": "Fore Arm"},
        {"kind": "pose_tracker", "stream": "camera_head", **IDS},
        {"kind": "pose_tracker", "stream": "Elbow", **IDS},
        {"kind": "camera", "stream": "table", "port": 2},
        {"kind": "camera", "stream": "camera_", "port": 2},
    ],
)
def test_names_of_other_roles_are_refused(device):
    with pytest.raises(ValidationError, match=r"devices\.0\.(stream|label)"):
        AcquisitionSettings(devices=[device])


def pose_from(source):
    pose = PAYLOAD.pack(200, 0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0)
    data = encode_packet(MAGIC, Packet(VERSION, SOURCES[source], 1, 10_000_000, pose))
    return PoseTrackerDecoder("elbow_left").decode(
        b"".join(split_into_reports(DATA_REPORT, 1, data)), 5
    )


def test_a_tracker_elsewhere_says_that_it_sits_on_no_wrist():
    (sample,) = pose_from("none")["elbow_left"]
    np.testing.assert_allclose(sample.values, [0.1, 0.2, 0.3, 1, 0, 0, 0], rtol=1e-6)
    with pytest.raises(DeviceError, match="says it is 'left', expected 'none'"):
        pose_from("left")


def test_a_port_that_cannot_be_opened_names_what_tells_why():
    with pytest.raises(DeviceError, match=r"/dev/none: cannot be opened .*; .*`dextouch doctor`"):
        SerialTransport(lambda: "/dev/none").open()


def test_a_host_that_has_no_name_is_absent():
    with pytest.raises(DeviceError, match=r"socket glove\.\.lab:1: cannot be opened"):
        tcp_transport("glove..lab", 1).open()
