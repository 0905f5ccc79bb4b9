"""MuJoCo's warnings go to our log, and no file appears in the current folder."""

import mujoco
from structlog.testing import capture_logs

import services.twin.scene  # noqa: F401 - installs the handler

FREE_BALL = """
<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>
"""


def test_an_unstable_simulation_is_logged(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = mujoco.MjModel.from_xml_string(FREE_BALL)
    data = mujoco.MjData(model)
    data.qpos[0] = float("nan")
    with capture_logs() as events:
        mujoco.mj_step(model, data)
    assert [event["event"] for event in events] == ["physics_warning"]
    assert "QPOS at DOF 0" in events[0]["text"]
    assert list(tmp_path.iterdir()) == []
