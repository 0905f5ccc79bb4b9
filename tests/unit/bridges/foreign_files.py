"""MCAP files as other tools write them, with Foxglove's schemas and with JSON of anyone."""

import importlib
import io
import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, Writer
from PIL import Image

GOLDEN = Path(__file__).parents[2] / "golden" / "ros2_rosbags.mcap"
T0 = 1_700_000_000_000_000_000
STEP = 33_333_333
PIXELS = np.random.default_rng(5).integers(0, 255, (8, 48, 64, 3), dtype=np.uint8)


def schema_of(name):
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


class Recorder:
    """A file by mcap's writer, with topics of Foxglove's protobuf messages or JSON."""

    def __init__(self, path, compression=CompressionType.LZ4):
        self.path, self.channels = path, {}
        self.writer = Writer(str(path), compression=compression, chunk_size=4096)
        self.writer.start()

    def channel(self, topic, name, encoding="protobuf", schema=None, message_encoding=None):
        if schema is None:
            schema = self.schema(name) if name else b""
        number = self.writer.register_schema(name, encoding, schema) if encoding else 0
        said = message_encoding or ("protobuf" if encoding == "protobuf" else "json")
        self.channels[topic] = self.writer.register_channel(topic, said, number)

    @staticmethod
    def schema(name):
        files = {}

        def add(file):
            for dependency in file.dependencies:
                add(dependency)
            files.setdefault(file.name, file)

        add(schema_of(name.removeprefix("foxglove.")).DESCRIPTOR.file)
        found = FileDescriptorSet()
        for file in files.values():
            file.CopyToProto(found.file.add())
        return found.SerializeToString()

    def add(self, topic, name, t_ns, *, log_ns=None, **fields):
        if topic not in self.channels:
            self.channel(topic, f"foxglove.{name}")
        message = schema_of(name)(**fields)
        if "timestamp" in message.DESCRIPTOR.fields_by_name:
            message.timestamp.FromNanoseconds(t_ns)
        self.raw(topic, message.SerializeToString(), t_ns + 5 if log_ns is None else log_ns)

    def raw(self, topic, data, t_ns):
        data = data if isinstance(data, bytes) else json.dumps(data).encode()
        self.writer.add_message(self.channels[topic], t_ns, data, t_ns)

    def done(self):
        self.writer.finish()
        return self.path


def encoded(pixels, form):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, form)
    return file.getvalue()


def video(num_images, *, keyint, codec="libx264", bframes=0, tune="zerolatency", size_px=(48, 64)):
    """Access units of an encoder that is not the store's; image k has level 20 (k mod 10)."""
    av = pytest.importorskip("av")
    encoder = av.CodecContext.create(codec, "w")
    (encoder.height, encoder.width), encoder.pix_fmt = size_px, "yuv420p"
    encoder.time_base = Fraction(1, 30)
    option = {"libx264": "x264-params", "libx265": "x265-params"}[codec]
    encoder.options = {
        "tune": tune,
        option: f"keyint={keyint}:min-keyint={keyint}:scenecut=0:bframes={bframes}:log-level=none",
    }
    units = []
    for index in range(num_images):
        frame = av.VideoFrame.from_ndarray(np.full((*size_px, 3), 20 * (index % 10), np.uint8))
        frame.pts = index
        units += [bytes(packet) for packet in encoder.encode(frame)]
    return units + [bytes(packet) for packet in encoder.encode(None)]


def foxglove_file(path):
    recorder = Recorder(path)
    recorder.channel("/nothing", "foxglove.PoseInFrame")
    for k in range(8):
        t, add = T0 + k * STEP, recorder.add
        for topic, form in (("/cam/jpeg", "jpeg"), ("/cam/png", "png")):
            data = encoded(PIXELS[k], form)
            add(topic, "CompressedImage", t, data=data, format=form, frame_id="cam")
        size = {"width": 64, "height": 48, "frame_id": "cam"}
        rows = np.pad(PIXELS[k, ..., ::-1].reshape(48, 192), ((0, 0), (0, 8)))
        add("/cam/raw", "RawImage", t, data=rows.tobytes(), encoding="bgr8", step=200, **size)
        deep = (PIXELS[k, ..., 0].astype("<u2") * 256 + k).tobytes()
        add("/cam/deep", "RawImage", t, data=deep, encoding="mono16", step=128, **size)
        hands = [
            {
                "parent_frame_id": "world",
                "child_frame_id": child,
                "translation": {"x": k, "y": 2, "z": 3},
                "rotation": {"x": 0.1, "y": 0.2, "z": 0.3, "w": 0.9},
                "timestamp": {"seconds": t // 10**9, "nanos": t % 10**9},
            }
            for child in ("left", "right")
        ]
        add("/tf", "FrameTransforms", t, transforms=hands)
        pose = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"w": 1}}
        add("/pose", "PoseInFrame", t, pose=pose, frame_id="map")
        add("/poses", "PosesInFrame", t, poses=[pose] * 25, frame_id="wrist")
        points = np.arange(4 * (2 + k % 2), dtype="<f4")
        fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyzi")]
        cloud = {"point_stride": 16, "fields": fields, "data": points.tobytes()}
        add("/points", "PointCloud", t, frame_id="lidar", **cloud)
        joints = [{"name": "a", "position": 0.5}, {"name": "b", "position": 1.5, "velocity": 2}]
        add("/joints", "JointStates", t, joints=joints[:: 1 - 2 * (k % 2)])
        add("/log", "Log", t, message="hello", line=4)
    K = [50, 0, 31.5, 0, 50, 23.5, 0, 0, 1]
    D = [0.1, 0.2, 0, 0, 0]
    add("/cam/info", "CameraCalibration", T0, K=K, D=D, distortion_model="plumb_bob", **size)
    return recorder.done()


def json_file(path, messages):
    """A file of JSON messages without a schema: topic, schema and message, a millisecond apart."""
    recorder = Recorder(path)
    for k, (topic, schema, message) in enumerate(messages):
        if topic not in recorder.channels:
            recorder.channel(topic, schema, "jsonschema" if schema else "", b"{}")
        recorder.raw(topic, message, T0 + k * 10**6)
    return recorder.done()
