"""Deployment files against what they must be: valid, without privileges, and true to the code."""

import importlib
import json
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from services.acquisition.settings import AcquisitionSettings
from services.acquisition.take import STALL_NS
from services.cli.main import COMMANDS, find_command
from services.episode_store.parser import store_parser
from tests.containers import engine
from tests.containers.engine import PACKAGES
from tests.system.compose_processes import VARIABLE, keys_of

ROOT = Path(__file__).parents[3]
COMPOSE = ROOT / "docker-compose.yml"
SERVICES = yaml.safe_load(COMPOSE.read_text())["services"]
# Port inside the container of services that are not ours.
FOREIGN_PORTS = {"redis": "none", "gateway": r"\d+", "prometheus": "9090", "grafana": "3000"}
FOREIGN = tuple(FOREIGN_PORTS)
OURS = {name: service for name, service in SERVICES.items() if name not in FOREIGN}


def validates(path):
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"]
    done = subprocess.run([*command, str(path)], capture_output=True, check=False, cwd=ROOT)
    return done.returncode == 0


@pytest.mark.parametrize("path", ["docker-compose.yml", "deploy/compose.devices.yml"])
def test_compose_files_are_valid(path):
    assert validates(ROOT / path)


def test_a_misspelt_condition_is_caught(tmp_path):
    text = COMPOSE.read_text()
    wrong = tmp_path / "docker-compose.yml"
    wrong.write_text(text.replace("service_healthy", "service_wealthy", 1))
    assert "service_wealthy" in wrong.read_text()
    assert not validates(wrong)


@pytest.mark.parametrize("name", SERVICES)
def test_no_privileges(name):
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert not service.get("privileged")
    for port in service.get("ports", []):
        inside = FOREIGN_PORTS.get(name, "8000")
        assert re.fullmatch(rf"127\.0\.0\.1:\$\{{DEXTOUCH_\w+_PORT:-\d+\}}:{inside}", port)


@pytest.mark.parametrize("name", [name for name in SERVICES if not SERVICES[name].get("profiles")])
def test_lasting_services_have_health_and_a_place(name):
    assert SERVICES[name]["healthcheck"]["test"][0] == "CMD"
    for other, rule in SERVICES[name].get("depends_on", {}).items():
        assert other in SERVICES
        assert rule["condition"] == "service_healthy"


def test_published_ports_differ():
    ports = [port for service in SERVICES.values() for port in service.get("ports", [])]
    defaults = [re.search(r":-(\d+)", port).group(1) for port in ports]
    assert len(set(defaults)) == len(defaults)


@pytest.mark.parametrize("name", OURS)
def test_commands_and_variables_exist(name):
    program, *words = OURS[name]["command"]
    assert program == "dextouch"
    command, _ = find_command(words)
    module = "services." + COMMANDS[command].target.partition(":")[0].rpartition(".")[0]
    folder = Path(importlib.import_module(module).__file__).parent
    prefix = f"DEXTOUCH_{module.removeprefix('services.').upper()}_"
    # Settings stand in settings.py; those of serving a world may stand beside the serving.
    files = [name for name in ("settings", "serving") if (folder / f"{name}.py").is_file()]
    known = {
        (kind.model_config.get("env_prefix", "") + field).upper()
        for name in files
        for kind in vars(importlib.import_module(f"{module}.{name}")).values()
        if isinstance(kind, type) and hasattr(kind, "model_fields")
        for field in kind.model_fields
    }
    wanted = {key for key in OURS[name].get("environment", {}) if key.startswith(prefix)}
    unknown = {key for key in wanted if key.split("__")[0] not in known}
    assert not unknown


def test_the_gateway_knows_the_services_that_may_have_many_workers():
    text = (ROOT / "deploy/haproxy/haproxy.cfg").read_text()
    published = {port.rpartition(":")[2] for port in SERVICES["gateway"]["ports"]}
    assert set(re.findall(r"^  bind :(\d+)$", text, re.M)) == published
    behind = dict(re.findall(r"^  server-template (\w+) \d+ (\w+):8000 ", text, re.M))
    assert set(behind) == set(behind.values()) == {"twin", "world_model"}
    for name in behind:
        # A host's port can belong to one worker only.
        assert "ports" not in SERVICES[name]
        prefix = f"DEXTOUCH_{name.upper()}_"
        environment = OURS[name]["environment"]
        assert environment[prefix + "STATE_URL"].startswith("redis://redis:6379/")
        # The gateway asks twice a second, and looks elsewhere after two refusals.
        assert float(environment[prefix + "DRAIN_S"]) > 2 * 0.5
    assert "check inter 500ms fall 2 " in text


def test_the_documented_packages_are_those_of_the_programs_that_container_tests_run():
    (listed,) = re.findall(r"`apt-get install ([^`]+)`", (ROOT / "docs/images.md").read_text())
    assert set(listed.split()) == {*PACKAGES.values(), "chromium"}


def test_a_missing_program_is_named(monkeypatch, tmp_path):
    for program in set(PACKAGES) - {"iptables"}:
        if not program.startswith("/"):
            (tmp_path / program).touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(engine.os, "getuid", lambda: 0)
    assert "no iptables" in engine.missing()
    assert "apt-get install iptables" in engine.missing()


def test_what_training_writes_can_be_served():
    def mounted(name):
        volumes = [volume.split(":") for volume in SERVICES[name]["volumes"]]
        return {inside: source for source, inside, *_ in volumes}

    words = SERVICES["training"]["command"]
    output = Path(words[words.index("--output") + 1])
    folder = str(output.parent)
    assert mounted("world_model")[folder] == mounted("training")[folder]
    passed = SERVICES["world_model"]["environment"]["DEXTOUCH_WORLD_MODEL_CHECKPOINT"]
    assert passed == "${DEXTOUCH_WORLD_MODEL_CHECKPOINT:-}"


WORLD = {
    "administrator": {"rollout", "watch"},
    "dashboard": {"rollout", "watch"},
    "evaluation": {"rollout"},
}
# What each key may do in each service, and the containers that have it to use.
SCOPES_OF_KEYS = {
    "episode_store": {
        "administrator": {"store_read", "store_write", "store_expire", "store_delete", "enrol"},
        "dashboard": {"store_read", "store_delete", "enrol"},
        "station": {"store_write"},
    },
    "alignment": {"administrator": {"align"}, "dashboard": {"align"}},
    "acquisition": {"administrator": {"station"}, "dashboard": {"station"}},
    "twin": WORLD,
    "world_model": WORLD,
    "studies": {"administrator": {"study_read"}, "dashboard": {"study_read"}},
    "dashboard": {"administrator": {"operate", "enrol"}},
}
USERS = {
    "DEXTOUCH_KEY": set(),
    "DEXTOUCH_STATION_KEY": {"acquisition"},
    "DEXTOUCH_DASHBOARD_KEY": {"dashboard"},
    "DEXTOUCH_EVALUATION_KEY": {"evaluation"},
    "DEXTOUCH_GRAFANA_PASSWORD": {"grafana"},
}


def test_every_service_has_a_key_of_its_own_with_the_scopes_that_it_needs():
    names = {}
    for service, expected in SCOPES_OF_KEYS.items():
        keys = json.loads(SERVICES[service]["environment"][f"DEXTOUCH_{service.upper()}_API_KEYS"])
        assert {key["name"]: set(key["scopes"]) for key in keys} == expected, service
        for key in keys:
            names.setdefault(key["name"], set()).add(VARIABLE.fullmatch(key["key"])[1])
    # A name is always that of the same key, and no two names share one.
    assert all(len(variables) == 1 for variables in names.values())
    assert len(set.union(*names.values())) == len(names)
    for variable, users in USERS.items():
        using = {
            service
            for service, given in SERVICES.items()
            for name, value in given.get("environment", {}).items()
            if not name.endswith("_API_KEYS") and f"${{{variable}:?" in str(value)
        }
        assert using == users, variable
    # A station records under the name of its key.
    assert AcquisitionSettings.model_fields["station"].default in SCOPES_OF_KEYS["episode_store"]


def test_one_command_makes_all_keys(tmp_path):
    (tmp_path / ".env").write_text("DEXTOUCH_KEY=one-that-was-there-before\n")
    command = ["sh", str(ROOT / "deploy/make_keys.sh")]
    for _ in range(2):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=True, text=True)
    assert "one-that-was-there-before" in done.stdout
    lines = (tmp_path / ".env").read_text().splitlines()
    made = dict(line.split("=") for line in lines)
    assert made.keys() == keys_of(COMPOSE).keys()
    assert len(lines) == len(made)
    assert made.pop("DEXTOUCH_KEY") == "one-that-was-there-before"
    assert len(set(made.values())) == len(made)
    for key in made.values():
        assert re.fullmatch("[0-9a-f]{64}", key)


def test_a_new_file_of_keys_is_for_its_owner_only(tmp_path):
    subprocess.run(["sh", str(ROOT / "deploy/make_keys.sh")], cwd=tmp_path, check=True)
    assert stat.S_IMODE((tmp_path / ".env").stat().st_mode) == 0o600


def test_rollouts_outlast_a_restart_of_redis():
    words = SERVICES["redis"]["command"]
    assert words[words.index("--appendonly") + 1] == "yes"
    assert "redis:/data" in SERVICES["redis"]["volumes"]


def test_image_runs_without_root_and_with_health():
    text = (ROOT / "deploy/Dockerfile").read_text()
    stages = re.findall(r"^FROM (\S+) AS (\S+)$", text, re.MULTILINE)
    assert stages[-2:] == [("runtime", "light"), ("runtime", "model")]
    runtime, light, model = re.split("AS light|AS model", text[text.index("AS runtime") :])
    assert "HEALTHCHECK" in runtime
    for last in (light, model):
        assert re.search(r"^COPY --from=code /opt/code /opt/code\nUSER 10001:10001$", last, re.M)
    # What the wheel does not contain cannot be imported in the image.
    assert not re.search(r"\bfrom services\b", text)
    for service in OURS.values():
        assert service["build"]["target"] in {"light", "model"}
        assert service["image"] == f"dextouch:{service['build']['target']}"


def test_what_the_image_copies_is_let_into_its_build():
    text = (ROOT / "deploy/Dockerfile").read_text()
    let_in = set((ROOT / "deploy/Dockerfile.dockerignore").read_text().split())
    copied = {
        name for line in re.findall(r"^COPY (?!--)(.+) \S+$", text, re.M) for name in line.split()
    }
    assert {"docs", "services", "pyproject.toml"} <= copied
    for name in copied:
        assert f"!{name}" in let_in or f"!{name}/dextouch" in let_in, name


def test_udev_rules_parse_and_name_devices_once():
    lines = (ROOT / "deploy/udev/60-dextouch.rules").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    names = []
    for rule in rules:
        parts = [part.strip() for part in rule.split(",")]
        for part in parts:
            assert re.fullmatch(r'[A-Z]+(\{\w+\})?(==|\+=|=)"[^"]*"', part), part
        names += re.findall(r'SYMLINK\+="(dextouch/\w+)"', rule)
        assert 'GROUP="dextouch"' in parts
    assert len(set(names)) == len(names) == len(rules)


def test_container_and_unit_let_in_the_same_devices():
    # Fixed by the kernel (admin-guide/devices.txt); that of hidraw is not.
    majors = {"ttyACM": "166", "ttyUSB": "188", "usb_device": "189", "video4linux": "81"}
    devices = yaml.safe_load((ROOT / "deploy/compose.devices.yml").read_text())
    rules = devices["services"]["acquisition"]["device_cgroup_rules"]
    numbers = set(re.findall(r"^c (\d+):", "\n".join(rules), re.M))
    unit = (ROOT / "deploy/systemd/dextouch-station@.service").read_text()
    names = set(re.findall(r"^DeviceAllow=char-(\w+) rw$", unit, re.M))
    assert names == {*majors, "hidraw"}
    assert numbers == set(majors.values())


def test_a_container_with_devices_is_no_mock_and_says_which_devices():
    services = yaml.safe_load((ROOT / "deploy/compose.devices.yml").read_text())["services"]
    given = services["acquisition"]["environment"]
    assert given["DEXTOUCH_ACQUISITION_MOCK"] == "false"
    assert VARIABLE.fullmatch(given["DEXTOUCH_ACQUISITION_DEVICES"])[2] == "?"
    fields = {name.removeprefix("DEXTOUCH_ACQUISITION_").lower() for name in given}
    assert fields <= set(AcquisitionSettings.model_fields)


def test_prometheus_scrapes_every_service():
    config = yaml.safe_load((ROOT / "deploy/prometheus/prometheus.yml").read_text())
    (job,) = config["scrape_configs"]
    targets = {target for entry in job["static_configs"] for target in entry["targets"]}
    lasting = {name for name, service in OURS.items() if not service.get("profiles")}
    (found,) = job["dns_sd_configs"]
    assert (found["type"], found["port"], found["names"]) == ("A", 8000, ["twin", "world_model"])
    assert targets == {f"{name}:8000" for name in lasting - set(found["names"])}


def test_all_threads_of_a_station_share_one_heap_as_in_the_soak_test():
    """With more of them a station grows from take to take."""
    unit = (ROOT / "deploy/systemd/dextouch-station@.service").read_text()
    assert "\nEnvironment=MALLOC_ARENA_MAX=1\n" in unit
    assert OURS["acquisition"]["environment"]["MALLOC_ARENA_MAX"] == "1"
    assert '"MALLOC_ARENA_MAX": "1"' in (ROOT / "tests/system/test_station_soak.py").read_text()
    # All other services: a few.
    assert re.search(r"\bMALLOC_ARENA_MAX=2\b", (ROOT / "deploy/Dockerfile").read_text())


UNITS = sorted((ROOT / "deploy/systemd").glob("*.service"))


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze")
@pytest.mark.parametrize("unit", UNITS, ids=[unit.name for unit in UNITS])
def test_systemd_accepts_the_units(unit, tmp_path):
    text = unit.read_text().replace("/opt/dextouch/bin/dextouch", "/bin/true")
    (tmp_path / unit.name).write_text(text)
    name = unit.name.replace("@", "@desk_3")
    done = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / name)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_a_station_reports_to_systemd_that_it_works():
    (unit,) = (one.read_text() for one in UNITS if one.name == "dextouch-station@.service")
    assert "\nType=notify\n" in unit
    watchdog_s = int(re.search(r"^WatchdogSec=(\d+)$", unit, re.M)[1])
    # Two feeds a period, each after a look that may wait for the disk.
    assert watchdog_s / 2 > STALL_NS / 1e9
    assert "\nRestart=always\n" in unit
    (command,) = re.findall(r"^ExecStart=/opt/dextouch/bin/dextouch (.+)$", unit, re.M)
    assert find_command(command.split())[0] == "station serve"


def test_a_station_writes_only_where_its_unit_lets_it():
    unit = (ROOT / "deploy/systemd/dextouch-station@.service").read_text()
    (folder,) = re.findall(r"^StateDirectory=(.+)$", unit, re.M)
    own = f"/var/lib/{folder.replace('%i', 'desk_3')}"
    guide = (ROOT / "docs/stations.md").read_text()
    settings = guide[guide.index("# /etc/dextouch/desk_3.env") :].partition("```")[0]
    places = re.findall(r"^DEXTOUCH_\w+=(/var/lib/.+)$", settings, re.M)
    assert all(place.startswith(f"{own}/") for place in places), places
    # Compiled code is kept, too; otherwise every start compiles.
    for name in ("station@", "alignment"):
        unit = (ROOT / f"deploy/systemd/dextouch-{name}.service").read_text()
        (folder,) = re.findall(r"^CacheDirectory=(.+)$", unit, re.M)
        assert f"\nEnvironment=NUMBA_CACHE_DIR=/var/cache/{folder}\n" in unit


SERVED = {
    "store": "store serve",
    "alignment": "align serve",
    "dashboard": "dashboard",
    "world-model": "serve",
}


@pytest.mark.parametrize(("name", "command"), SERVED.items())
def test_units_start_commands_that_exist_on_the_ports_of_the_tls_examples(name, command):
    unit = (ROOT / f"deploy/systemd/dextouch-{name}.service").read_text()
    (words,) = re.findall(r"^ExecStart=/opt/dextouch/bin/dextouch (.+)$", unit, re.M)
    found, flags = find_command(words.split())
    assert (found, flags[0]) == (command, "--port")
    for line in ("Type=notify", "Restart=always", "NoNewPrivileges=true", "ProtectSystem=strict"):
        assert f"\n{line}\n" in unit
    if name in {"store", "dashboard"}:
        for example in ("nginx/dextouch.conf", "caddy/Caddyfile"):
            assert f"127.0.0.1:{flags[1]}" in (ROOT / "deploy" / example).read_text()
    assert "\nExecReload=/bin/kill -HUP $MAINPID\n" in unit


def test_the_backup_is_made_by_a_command_that_exists():
    unit = (ROOT / "deploy/systemd/dextouch-backup.service").read_text()
    (words,) = re.findall(r"^ExecStart=/opt/dextouch/bin/dextouch (.+)$", unit, re.M)
    command, rest = find_command(words.split())
    assert (command, store_parser().parse_args(rest).command) == ("store", "backup")
    # Of the store that is served, wherever its settings say that it is.
    served = (ROOT / "deploy/systemd/dextouch-store.service").read_text()
    (settings,) = re.findall(r"^EnvironmentFile=.+$", served, re.M)
    assert settings in unit.splitlines()
