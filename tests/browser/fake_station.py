"""A station that answers at once and nearly always the same: ten streams, three cameras, two hands.

`state` and `faults` are set by tests; devices and a recorder would load a small machine.
"""

import itertools

import numpy as np
from fastapi import FastAPI, Response

from dextouch.hands import NUM_KEYPOINTS
from dextouch.images import encode_jpeg
from dextouch.streams import pack

DEVICES = {
    "glove_left": ["tactile_left"],
    "glove_right": ["tactile_right"],
    "robot": ["joints_measured", "joints_commanded", "wrist_left", "wrist_right"],
    "tracker_head": ["head"],
    "camera_head": ["camera_head"],
    "camera_left": ["camera_wrist_left"],
    "camera_right": ["camera_wrist_right"],
}
CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
ACTIONS = {
    "idle": ["arm"],
    "armed": ["arm", "record", "discard"],
    "recording": ["stop", "discard", "rerecord"],
    "checking": ["save", "discard", "rerecord"],
    "saved": ["arm"],
}
PROMPT = {
    "task": "stand_bottle",
    "instruction": "Pick up the bottle lying on the table and stand it upright.",
    "domain": "human",
    "operator": "p07",
    "consent": True,
}
TAKE = "20261130-101500-4f2a1c"
FOLLOWING = {
    "level": "WARN",
    "lasted_s": 1.2,
    "message": "Robot's index finger: too fast to follow",
}


class FakeStation:
    """Its routes, and what they say."""

    def __init__(self):
        self.state, self.faults, self.needs_consent = "idle", [], False
        self.causes, self.asked = [], []
        # What is the same for 0.8 s counts as old.
        self._age_s = itertools.cycle((0.010, 0.011, 0.012))
        self.app = FastAPI()
        self.app.get("/v1/recorder")(self.recorder)
        self.app.get("/v1/health")(self.health)
        self.app.get("/v1/live/{what}")(self.live)
        self.app.get("/v1/live/cameras/{name}")(self.image)
        self.app.get("/v1/uploads/{name}")(lambda: {"recording_id": TAKE, "uploaded": True})
        self.app.get("/v1/uploads")(self.uploads)
        self.app.post("/v1/recorder/{action}")(self.act)
        self.app.post("/v1/faults/{fault}")(self.set_fault)

    def uploads(self):
        return []

    def act(self, action: str, body: dict):
        self.asked.append((action, body))
        return self.recorder()

    def set_fault(self, fault: str, body: dict):
        self.faults = [one for one in self.faults if one != fault] + [fault] * body["on"]
        return self.faults

    def recorder(self):
        is_told = self.state not in ("idle", "saved")
        status = {
            "state": self.state,
            "actions": ACTIONS[self.state],
            "prompt": PROMPT if is_told else None,
            "session": {"started_at": "2026-11-30T08:00:00Z", "last_saved": TAKE}
            | {"saved": [{"task": "stand_bottle", "operator": "p07", "num_saved": 12}]},
            "needs_consent": self.needs_consent,
        }
        if self.state in ("recording", "checking", "saved"):
            status |= {"recording_id": TAKE, "duration_s": 8.4}
        if self.state == "checking":
            problems = [
                {"stream": name, "code": code, "level": "ERROR", "message": f"{name}: {text}"}
                for name in ("tactile_left", "tactile_right", "head")
                for code, text in (("gap", "0.6 s without a sample"), ("rate", "55.1 Hz"))
            ]
            cause = {"message": "glove_left: not connected", "advice": "End its fault."}
            status["check"] = {"complete": False, "duration_s": 8.4, "streams": []}
            status["check"] |= {"problems": problems, "cause": cause}
        return status

    def health(self):
        touched = {name for cause in self.causes for name in cause["streams"]}
        streams = [
            {
                "stream": name,
                "device": device,
                "level": "ERROR" if name in touched else "OK",
                "reasons": [],
                "findings": [],
                "rate_hz": 59.9,
                "nominal_rate_hz": 60.0,
                "age_s": next(self._age_s),
                "received": 998,
                "lost": 2,
                "skew_ppm": 12.0,
                "clock_residual_ms": 0.3,
            }
            | (
                {"hand": name.rpartition("_")[2], "following": self.following(name)}
                if name.startswith("tactile")
                else {}
            )
            for device, names in DEVICES.items()
            for name in names
        ]
        figures = {"host_cpu_ratio": 0.42, "host_wake_p90_seconds": 0.002, "disk_free_bytes": 5e10}
        level = "ERROR" if self.causes else "OK"
        health = {"station": "desk", "level": level, "causes": self.causes, "figures": figures}
        return health | {"streams": streams, "devices": [], "faults": self.faults}

    def following(self, name):
        if name == "tactile_left":
            return FOLLOWING
        return {"level": "OK", "lasted_s": 9.0, "message": "Robot's hand: follows"}

    def live(self, what: str):
        if what == "cameras":
            size = {"height_px": 240, "width_px": 320, "image_index": 7, "age_s": next(self._age_s)}
            return {"cameras": [{"name": name} | size for name in CAMERAS]}
        if what == "taxels":
            kpa = 20 + 20 * np.sin(np.arange(320) / 25 + next(self._age_s))
            arrays = {f"tactile_{side}": kpa.astype(np.float32) for side in ("left", "right")}
            return Response(pack({}, arrays))
        poses = {
            name: np.eye(4, dtype=np.float32) for name in ("head", "wrist_left", "wrist_right")
        }
        for number, name in enumerate(poses):
            poses[name][:3, 3] = (0.1 * number, 0.3 * number - 0.3, 0.3)
        poses["keypoints_left"] = np.zeros((NUM_KEYPOINTS, 3), np.float32)
        return Response(pack({"age_s": dict.fromkeys(poses, next(self._age_s))}, poses))

    def image(self, name: str):
        ramp = np.linspace(40, 220, 320).astype(np.uint8)
        image = np.broadcast_to(ramp[None, :, None], (240, 320, 3)).copy()
        image[..., CAMERAS.index(name)] //= 2
        return Response(encode_jpeg(image), media_type="image/jpeg")
