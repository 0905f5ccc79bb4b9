"""A recording and an episode whose every sample says which one it is, and the arrays they hold.

Images show their index as twelve black or white cells, which survives JPEG and H.264; taxels 80 to
91 are 0 or 40 kPa in the same way. What the tests expect comes from these arrays.
"""

from types import SimpleNamespace

import numpy as np

from dextouch.hands import actions as act
from dextouch.hands.skeleton import mean_hand_m
from dextouch.images import encode_jpeg
from dextouch.schemas import ClockReport, EpisodeAttributes, LineageEntry, RecordingAttributes
from dextouch.streams import StreamDescriptor, encoded_values

NUM_BITS = 12
ROWS, COLUMNS = 3, 4
HEIGHT_PX, WIDTH_PX = 96, 128
FIRST_BIT_TAXEL = 80
FULL_KPA = 40.0
DURATION_S = 20
GAP_S = (4.0, 6.5)
# Beyond 2^53, where JavaScript's numbers are no longer whole.
START_HOST_NS = 1_760_000_000_123_456_789
ORIGIN_AFTER_START_NS = 250_000_007
IDENTITY_ROWS = [[float(i == j) for j in range(4)] for i in range(4)]
POSES = ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head")
HOSTILE = "<img src=x onerror=\"document.title='broken'\"><script>document.title='broken'</script>"
TRACE_ID = "4bf92f3577b34da6a3ce929d0e0e4736"


def bits_of(index):
    return (np.asarray(index)[..., None] >> np.arange(NUM_BITS)) & 1


def index_of(bits):
    return int(sum(int(bit) << place for place, bit in enumerate(bits)))


def coded_images(count):
    cells = bits_of(np.arange(count)).reshape(count, ROWS, COLUMNS)
    gray = cells.repeat(HEIGHT_PX // ROWS, axis=1).repeat(WIDTH_PX // COLUMNS, axis=2)
    return np.repeat((20 + 215 * gray).astype("u1")[..., None], 3, axis=3)


def coded_taxels(count):
    values = np.zeros((count, 320), dtype="f4")
    values[:, FIRST_BIT_TAXEL : FIRST_BIT_TAXEL + NUM_BITS] = FULL_KPA * bits_of(np.arange(count))
    return values


def stamps(rng, rate_hz, *, gap_s=None, start_s=0.0):
    """Times with a jitter of a fifth of a period to the nanosecond, and no samples inside a gap."""
    period_ns = 1e9 / rate_hz
    count = round((DURATION_S - start_s) * rate_hz)
    jitter = rng.integers(-int(0.1 * period_ns), int(0.1 * period_ns), count)
    t_ns = np.rint(start_s * 1e9 + np.arange(count) * period_ns).astype(np.int64) + jitter
    if gap_s is not None:
        t_ns = t_ns[(t_ns < gap_s[0] * 1e9) | (t_ns > gap_s[1] * 1e9)]
    return t_ns


def poses(t_ns, offset):
    turn = 0.4 * np.sin(2e-9 * t_ns)
    values = np.zeros((len(t_ns), 7))
    values[:, 0] = offset + 0.1 * np.sin(1e-9 * t_ns)
    values[:, 2] = 0.3 + 0.05 * np.cos(1.5e-9 * t_ns)
    values[:, 3], values[:, 6] = np.cos(turn / 2), np.sin(turn / 2)
    return values


def _stream(name, kind, values, unit, rate_hz, **more):
    side = next((side for side in ("left", "right") if side in name and kind != "image"), None)
    described = {
        "name": name,
        "kind": kind,
        "shape": values.shape[1:],
        "dtype": str(values.dtype),
        "unit": unit,
        "nominal_rate_hz": rate_hz,
        "side": side,
    }
    return StreamDescriptor.model_validate(described | more)


def _image_values(images, unit):
    return encoded_values([encode_jpeg(image) for image in images]) if unit == "jpeg" else images


def write_episode(
    store, episode_id="episode-1", *, cameras=True, sides=("left", "right"), **changes
):
    """An episode with three cameras, two hands and actions; its arrays by stream."""
    rng = np.random.default_rng(5)
    streams = {}

    def add(name, kind, t_ns, values, unit, rate_hz, **more):
        streams[name] = SimpleNamespace(t_ns=t_ns, values=values)
        descriptors.append(_stream(name, kind, values, unit, rate_hz, **more))

    descriptors = []
    if cameras:
        for name, unit, rate_hz, gap_s in (
            ("camera_head", "jpeg", 30, GAP_S),
            ("camera_wrist_left", "rgb8", 25, None),
            ("camera_wrist_right", "h264", 30, (15.0, 15.3)),
        ):
            t_ns = stamps(rng, rate_hz, gap_s=gap_s)
            add(name, "image", t_ns, coded_images(len(t_ns)), unit, rate_hz)
    for side in sides:
        offset = -0.2 if side == "left" else 0.2
        t_ns = stamps(rng, 60)
        add(f"tactile_{side}", "tactile", t_ns, coded_taxels(len(t_ns)), "kPa", 60)
        t_ns = stamps(rng, 100, gap_s=GAP_S if side == "left" else None)
        add(f"wrist_{side}", "pose", t_ns, poses(t_ns, offset), "pose_m_wxyz", 100, frame="world")
        t_ns = stamps(rng, 120)
        points = np.repeat(mean_hand_m(side)[None], len(t_ns), axis=0)
        frame = f"wrist_{side}"
        add(f"keypoints_{side}", "keypoints", t_ns, points, "m", 120, frame=frame)
    t_ns = stamps(rng, 100)
    head = poses(t_ns, 0.0)
    head[:, 1:3] += 0.3
    add("head", "pose", t_ns, head, "pose_m_wxyz", 100)
    t_ns = np.rint(np.arange(DURATION_S * 15) * 1e9 / 15).astype(np.int64)
    rows = np.tile(act.IDENTITY_POSE_9D, (len(t_ns), 1))
    rows[:, 0] = 0.2 * np.sin(1e-9 * t_ns)
    joints = np.repeat((0.3 + 0.3 * np.sin(2e-9 * t_ns))[:, None], 20, axis=1)
    actions = act.pack_action(
        wrist_left=rows,
        wrist_right=rows,
        joints_left_rad=joints,
        joints_right_rad=joints,
        camera_head=np.tile(act.IDENTITY_POSE_9D, (len(t_ns), 1)),
    )
    add("action", "robot_state", t_ns, actions, "action", 15)
    attributes = EpisodeAttributes.model_validate(
        {
            "episode_id": episode_id,
            "task": "stand_bottle",
            "instruction": "stand the bottle up",
            "domain": "human",
            "origin": "recorded",
            "operator": "p17",
            "success": True,
            "trace_id": TRACE_ID,
            "anchor": dict.fromkeys(POSES, IDENTITY_ROWS),
            "K_head": [[60, 0, 64], [0, 60, 48], [0, 0, 1]],
            "quality": {"origin_after_start_ns": float(ORIGIN_AFTER_START_NS), "coverage": 0.98},
            "clocks": (
                ClockReport(stream="tactile_left", method="device", skew_ppm=3.5, num_samples=9),
            ),
            "lineage": (LineageEntry(kind="recording", id="take-1"),),
            **changes,
        }
    )
    with store.writer(attributes=attributes) as writer:
        for described in descriptors:
            one = streams[described.name]
            writer.add_stream(described)
            values = _image_values(one.values, described.unit)
            writer.append(described.name, values=values, t_ref_ns=one.t_ns)
    return streams


def write_recording(store, recording_id="take-1"):
    """The take that the episode names as its source: raw counts, and host times beyond 2^53."""
    rng = np.random.default_rng(6)
    streams, descriptors = {}, []
    for name, kind, unit, rate_hz in (
        ("camera_head", "image", "jpeg", 30),
        ("tactile_left", "tactile", "counts", 60),
    ):
        t_ns = START_HOST_NS + ORIGIN_AFTER_START_NS + stamps(rng, rate_hz)
        if kind == "image":
            values = coded_images(len(t_ns))
        else:
            values = rng.integers(200, 3000, (len(t_ns), 360)).astype("u2")
        streams[name] = SimpleNamespace(t_ns=t_ns, values=values)
        descriptors.append(_stream(name, kind, values, unit, rate_hz))
    attributes = RecordingAttributes(
        recording_id=recording_id,
        task="stand_bottle",
        instruction=HOSTILE,
        domain="human",
        station="bench",
        operator=HOSTILE,
        started_t_host_ns=START_HOST_NS,
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        for described in descriptors:
            one = streams[described.name]
            writer.add_stream(described)
            none = np.full(len(one.t_ns), -1, dtype=np.int64)
            writer.append(
                described.name,
                values=_image_values(one.values, described.unit),
                t_host_ns=one.t_ns,
                t_device_ns=none,
                sequence=none,
            )
    return streams
