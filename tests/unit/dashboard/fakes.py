"""A station and a store that answer as the real services do, from plain dictionaries."""

import httpx
import numpy as np
from fastapi import FastAPI, Response
from fastapi.responses import JSONResponse

from dextouch.streams import pack
from services.dashboard.upstream import Upstream

PRESSURES = {
    "left": np.linspace(0, 30, 320, dtype=np.float32),
    "right": np.zeros(320, dtype=np.float32),
}
EPISODE = {
    "episode_id": "take-0001",
    "task": "stack_bowls",
    "domain": "human",
    "origin": "recorded",
    "success": None,
    "num_steps": 81,
    "duration_s": 5.4,
    "content_sha256": "a" * 64,
}
EYE = np.eye(4).tolist()
DETAIL = {
    "attributes": {
        "episode_id": "take-0001",
        "task": "stack_bowls",
        "instruction": "stack the bowls",
        "domain": "human",
        "origin": "recorded",
        "anchor": {
            "T_world_wrist_left": EYE,
            "T_world_wrist_right": EYE,
            "T_world_camera_head": EYE,
        },
        "K_head": np.eye(3).tolist(),
        "clocks": [
            {"stream": "head", "skew_ppm": -49.7, "residual_rms_ms": 0.06, "num_samples": 530},
            {"stream": "tactile_left", "num_samples": 320, "num_dropped": 3},
        ],
    },
    "num_steps": 81,
    "content_sha256": "a" * 64,
}


class FakeServices:
    """Acquisition and store in one; tests change `health`, `recorder` and read `asked`."""

    def __init__(self):
        self.stream = {"stream": "tactile_left", "device": "glove_left", "level": "OK"}
        self.stream |= {"reasons": [], "rate_hz": 59.9, "nominal_rate_hz": 60.0, "age_s": 0.01}
        self.stream |= {"received": 998, "lost": 2}
        self.device = {"device": "glove_left", "connected": True, "address": "mock"}
        counted = ("packets", "lost", "crc_errors", "length_errors", "resync_bytes", "refused")
        self.device |= dict.fromkeys((*counted, "reconnects"), 0) | {"last_error": None}
        self.health = {"station": "desk", "level": "OK"}
        self.health |= {"streams": [self.stream], "devices": [self.device]}
        self.recorder = {"state": "idle", "actions": ["arm"]}
        self.asked = []
        self.app = FastAPI()
        self.app.middleware("http")(self._note)
        self.app.get("/readyz")(lambda: {"ready": True, "waiting_for": []})
        self.app.get("/v1/health")(lambda: JSONResponse(self.health))
        self.history = pack({"stream_series": ["rate_hz"], "nominal_rate_hz": {}}, {})
        self.app.get("/v1/health/history")(lambda: Response(self.history))
        self.app.get("/v1/recorder")(lambda: self.recorder)
        self.pressures = dict(PRESSURES)
        self.app.get("/v1/live/taxels")(self._taxels)
        self.app.get("/v1/live/poses")(self._poses)
        self.app.post("/v1/recorder/{action}")(self._act)
        self.episodes = [EPISODE]
        self.app.get("/v1/episodes")(self._list_episodes)
        self.app.get("/v1/episodes/{episode_id}")(lambda: DETAIL)
        self.recordings = []
        self.app.get("/v1/recordings")(self._list_recordings)
        self.enrolments = []
        self.app.get("/v1/enrolments")(self._list_enrolments)

    async def _note(self, request, call_next):
        self.asked.append(request.url.path)
        return await call_next(request)

    def _list_episodes(self, limit: int, sort: str = "id", descending: str = "false"):
        key = {"id": "episode_id", "time": "created_at"}[sort]
        ordered = sorted(
            self.episodes, key=lambda one: one.get(key, ""), reverse=descending == "true"
        )
        return {"episodes": ordered[:limit], "num_matching": len(self.episodes)}

    def _list_recordings(self):
        return {"recordings": self.recordings, "num_matching": len(self.recordings)}

    def _list_enrolments(self):
        return {"enrolments": self.enrolments, "needs_key": True}

    def _taxels(self):
        arrays = {f"tactile_{side}": values for side, values in self.pressures.items()}
        return Response(pack({}, arrays), media_type="application/msgpack")

    def _poses(self):
        ages_s = {"head": None, "wrist_left": 0.02}
        arrays = {"wrist_left": np.eye(4, dtype=np.float32)}
        return Response(pack({"age_s": ages_s}, arrays), media_type="application/msgpack")

    def _act(self, action: str, wanted: dict):
        if action == "record" and self.recorder["state"] != "armed":
            problem = {"type": "urn:dextouch:error:ConflictError", "title": "Conflict"}
            return JSONResponse(
                problem | {"status": 409, "detail": "record: got state idle, expected armed"}, 409
            )
        self.recorder = {"state": "armed", "actions": ["record", "discard"]}
        self.asked.append(wanted)
        return self.recorder

    def upstream(self, name):
        """This service under a name."""
        transport = httpx.ASGITransport(app=self.app)
        return Upstream(name, httpx.AsyncClient(transport=transport, base_url="http://fake"))


def broken_upstream(name):
    """A service whose socket is closed."""

    def refuse(request):
        raise httpx.ConnectError("refused", request=request)

    transport = httpx.MockTransport(refuse)
    return Upstream(name, httpx.AsyncClient(transport=transport, base_url="http://fake"))
