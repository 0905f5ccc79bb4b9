"""Generates clients of all services and uses two of them: `make check-api-client`.

The generated code must have a function for each operation, and the generator nothing to warn of.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from pydantic import SecretStr

from dextouch.episodes import EpisodeStore
from dextouch.serving.keys import ApiKey
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from services.pipelines.servers import served
from tests.contracts.service_apps import APPS
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write
from tests.unit.worlds.fakes import SumWorld

HERE = Path(__file__).parent
KEY = "a-key-of-some-length"
KEYS = (ApiKey(name="client", key=SecretStr(KEY), scopes=("rollout", "store_read")),)


def generate(python: str, document: dict, folder: Path) -> int:
    """Generate a client; returns its number of functions, which must be that of operations."""
    source = folder.with_suffix(".json")
    source.write_text(json.dumps(document))
    words = ["generate", "--path", str(source), "--output-path", str(folder), "--meta", "none"]
    words += ["--config", str(HERE / "generator.yml"), "--fail-on-warning"]
    subprocess.run([python, "-m", "openapi_python_client", *words], check=True)
    functions = [path.stem for path in folder.glob("api/*/*.py") if path.stem != "__init__"]
    named = [one["operationId"] for path in document["paths"].values() for one in path.values()]
    assert sorted(functions) == sorted(named), set(named) ^ set(functions)
    return len(functions)


def check(python: str) -> None:
    """Generate and use clients with the interpreter of the generator's environment."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        num_operations = 0
        (folder / "generated").mkdir()
        for name, make in APPS.items():
            (folder / name).mkdir()
            document = make(folder / name).openapi()
            num_operations += generate(python, document, folder / "generated" / name)
        store = folder / "store"
        write(EpisodeStore(str(store)), toy.demonstration("reach", 1, name="toy-1"))
        apps = {
            "worlds": create_world_app({"sum": SumWorld()}, WorldServiceSettings(api_keys=KEYS)),
            "store": create_store(EpisodeStoreSettings(store_url=str(store), api_keys=KEYS)),
        }
        with served(apps) as urls:
            words = [str(HERE / "client.py"), urls["worlds"], urls["store"], KEY]
            environment = {"PYTHONPATH": str(folder / "generated")}
            subprocess.run([python, *words], check=True, env=environment)
    sys.stdout.write(f"{num_operations} operations of {len(APPS)} services have functions\n")


if __name__ == "__main__":
    check(sys.argv[1])
