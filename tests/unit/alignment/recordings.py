"""Small robot recordings for tests of jobs and services."""

import numpy as np

from dextouch.images import jpeg_size
from dextouch.schemas import RecordingAttributes, matrix_rows
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values

K_HEAD = ((60.0, 0.0, 32.0), (0.0, 60.0, 32.0), (0.0, 0.0, 1.0))
POSE = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])
START_NS = 10**12


def write_recording(
    store,
    recording_id,
    *,
    streams=("wrist_left", "wrist_right", "head", "joints_measured"),
    seconds=2.0,
    lost=(),
    calibration=None,
    edit=lambda name, values: values,
    task="stand-bottle",
    trace_id=None,
    camera=None,
    num_joints=40,
):
    """A robot that stands still; `lost` are (stream, first, last) samples that never arrived.

    `calibration` is added to that of the recording, `edit` changes a stream's values, and `camera`
    is the matrix of a head camera with times (ns) and JPEG images.
    """
    if camera is not None:
        calibration = {**(calibration or {}), "K_head": matrix_rows(camera[0])}
    attributes = RecordingAttributes(
        recording_id=recording_id,
        task=task,
        instruction="",
        domain="robot",
        station="test",
        started_t_host_ns=START_NS,
        trace_id=trace_id,
        calibration={"K_head": K_HEAD, **(calibration or {})},
    )
    t_ns = np.arange(round(seconds * 100), dtype=np.int64) * 10_000_000
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name in streams:
            row = np.full(num_joints, 0.25) if name.startswith("joints") else POSE
            stream = StreamDescriptor(
                name=name,
                kind="pose" if len(row) == 7 else "robot_state",
                shape=row.shape,
                dtype="float64",
                unit="pose_m_wxyz" if len(row) == 7 else "rad",
                nominal_rate_hz=100,
            )
            writer.add_stream(stream)
            arrived = np.ones(len(t_ns), dtype=bool)
            for stream_name, first, last in lost:
                arrived[first:last] &= stream_name != name
            writer.append(
                name,
                values=edit(name, np.repeat(row[None], len(t_ns), axis=0)[arrived]),
                t_host_ns=t_ns[arrived] + START_NS,
                t_device_ns=t_ns[arrived] + 9 * 10**11,
            )
        if camera is not None:
            _, times_ns, images = camera
            stream = StreamDescriptor(
                name="camera_head",
                kind="image",
                shape=(*jpeg_size(images[0]), 3),
                dtype="uint8",
                unit="jpeg",
                nominal_rate_hz=30,
            )
            writer.add_stream(stream)
            values = encoded_values(images)
            writer.append("camera_head", values=values, t_host_ns=times_ns + START_NS)


def stamped(true_s, stamps_ns, rate_hz):
    """Numbered samples of a device that stamps them so; they arrive up to a millisecond later."""
    late_ns = np.random.default_rng(0).exponential(2e5, len(true_s)).clip(max=1e6)
    t_host_ns = START_NS + np.rint(np.asarray(true_s) * 1e9 + late_ns).astype(np.int64)
    descriptor = StreamDescriptor(
        name="wrist_left",
        kind="pose",
        shape=(7,),
        dtype="float64",
        unit="pose_m_wxyz",
        nominal_rate_hz=rate_hz,
    )
    values = np.repeat(POSE[None], len(true_s), axis=0)
    return SampleBatch(t_host_ns, np.asarray(stamps_ns), np.arange(len(true_s)), values), descriptor
