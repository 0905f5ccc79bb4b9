"""Full disks below the spool and the store: errors name the cause, nothing acknowledged is lost."""

import signal

import pytest

from tests.system.compose_processes import record_take, wait_for

pytestmark = pytest.mark.containers
TAKE_S = 3.0
# The uploader comes back 30 s after the store said that it is full; alignment after a minute.
FREED_TIMEOUT_S = 600.0
MIB = 1 << 20
PROMPT = {"task": "stand_bottle", "instruction": "stand the bottle up", "consent": True}


@pytest.fixture
def fill(disks):
    """Fill a disk; it is freed at the end in any case."""

    def fill(name, leave_bytes=0):
        disks[name].fill(leave_bytes=leave_bytes)
        assert disks[name].free_bytes() <= leave_bytes

    yield fill
    for disk in disks.values():
        disk.free()


@pytest.fixture
def refused(composed, client):
    """Ask a station for what its full disk must refuse; the reason."""

    def refused(action, body=None):
        answer = client.post(f"{composed.url('acquisition')}/v1/recorder/{action}", json=body)
        assert answer.status_code == 507, answer.text
        return answer.json()["detail"]

    return refused


def test_a_spool_that_fills_up_ends_the_take_and_keeps_it(
    composed, disks, ask, fill, refused, arrived
):
    ask("POST", "acquisition", "/v1/recorder/arm", json=PROMPT)
    recording_id = ask("POST", "acquisition", "/v1/recorder/record")["recording_id"]

    def status():
        return ask("GET", "acquisition", "/v1/recorder")

    wait_for("samples", 30, lambda: status()["duration_s"] > TAKE_S, composed.logs)
    before = status()["num_samples"]
    fill("spool")
    wait_for("end of the take", 60, lambda: status()["state"] == "checking", composed.logs)
    ended = status()
    assert "no space left" in ended["check"]["cause"]["message"]
    assert any("no space left" in problem for problem in ended["problems"])
    counted = {take["stream"]: take["num_samples"] for take in ended["check"]["streams"]}
    assert all(counted[name] >= count for name, count in before.items())
    save = {"success": True, "accept_incomplete": True}
    assert "space" in refused("save", save)
    composed.wait_healthy("acquisition")
    disks["spool"].free()
    assert ask("POST", "acquisition", "/v1/recorder/save", json=save)["state"] == "saved"
    arrived(recording_id, counted)
    arrived(*record_take(ask, TAKE_S, composed.logs))


def test_a_nearly_full_spool_begins_no_take(composed, disks, ask, fill, refused, arrived):
    fill("spool", leave_bytes=32 * MIB)
    ask("POST", "acquisition", "/v1/recorder/arm", json=PROMPT)
    reason = refused("record")
    assert "32 MiB free, 64 MiB are reserved" in reason
    assert "free space" in reason
    disks["spool"].free()
    arrived(*record_take(ask, TAKE_S, composed.logs))


@pytest.mark.parametrize("begun", [False, True], ids=["before", "during"])
def test_a_full_store_delays_the_upload_and_names_the_cause(
    composed, disks, ask, fill, uploading, arrived, begun
):
    if not begun:
        fill("store")
    recording_id, num_samples = record_take(ask, TAKE_S, composed.logs)
    if begun:
        uploading(recording_id)
        fill("store")

    def error():
        found = {item["recording_id"]: item for item in ask("GET", "acquisition", "/v1/uploads")}
        assert not found[recording_id]["uploaded"]
        assert not found[recording_id]["refused"]
        return found[recording_id]["error"] or ""

    wait_for("a reason", 300, lambda: "space" in error(), composed.logs)
    composed.wait_healthy("episode_store")
    disks["store"].free()
    arrived(recording_id, num_samples, limit_s=FREED_TIMEOUT_S)


def test_a_full_store_delays_the_alignment(composed, disks, ask, fill, arrived):
    def jobs(**query):
        return ask("GET", "alignment", "/v1/alignments", params=query)["alignments"]

    def idle():
        return {job["state"] for job in jobs()} <= {"done", "failed"}

    wait_for("alignments of other takes", FREED_TIMEOUT_S, idle, composed.logs)
    composed.signal("alignment", signal.SIGSTOP)
    recording_id, num_samples = record_take(ask, TAKE_S, composed.logs)
    arrived(recording_id, num_samples)
    # Enough for the list of jobs, not for an episode.
    fill("store", leave_bytes=MIB // 4)
    composed.signal("alignment", signal.SIGCONT)

    def job():
        (found,) = jobs(recording_id=recording_id) or [{"state": "none"}]
        return found

    wait_for("an attempt", FREED_TIMEOUT_S, lambda: job()["state"] == "failed", composed.logs)
    failed = job()
    assert failed["problem"]["status"] == 507, failed
    assert "no space left" in failed["problem"]["detail"]
    composed.wait_healthy("alignment")
    disks["store"].free()

    ended = []

    def ended_otherwise():
        # An attempt that began before there was space again ends like the first one.
        now = job()
        full = (now.get("problem") or {}).get("status") == 507
        if now["state"] in {"done", "failed"} and not full:
            ended.append(now)
        return bool(ended)

    wait_for("another attempt", FREED_TIMEOUT_S, ended_otherwise, composed.logs)
    # Mocks play in real time, so that a busy machine leaves gaps.
    assert ended[0]["state"] == "done" or "gap" in ended[0]["problem"]["detail"], ended
