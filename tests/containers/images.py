"""The images that the Dockerfile and the compose file begin with, pulled or made from Debian."""

import shutil
import time

from tests.containers.engine import REGISTRY, ROOT, answers

PYTHON = "docker.io/library/python:3.11-slim"
REDIS = "docker.io/library/redis:7-alpine"
HAPROXY = "docker.io/library/haproxy:3.2-alpine"
PROMETHEUS = "docker.io/prom/prometheus:v3.5.0"
TORCH_INDEX = "https://download.pytorch.org/whl/cpu/"
DEBIAN = ROOT / ".containers/bookworm.tar"
PACKAGES = "python3,python3-venv,python3-pip,python-is-python3,ca-certificates"
# As the official images do it: users, folders, signals and commands.
STAND_INS = """
FROM {python} AS debian
RUN apt-get update && apt-get install -y --no-install-recommends redis-server haproxy wget
FROM debian AS redis
RUN install --directory --owner=999 --group=1000 /data
WORKDIR /data
ENTRYPOINT ["sh", "-c", "exec \\"$@\\" --protected-mode no", "redis"]
USER 999:1000
FROM debian AS haproxy
USER 99:99
STOPSIGNAL SIGUSR1
CMD ["haproxy", "-W", "-db", "-f", "/usr/local/etc/haproxy/haproxy.cfg"]
FROM debian AS prometheus
RUN apt-get install -y --no-install-recommends prometheus \
 && install --directory --owner=65534 --group=65534 /prometheus
WORKDIR /prometheus
ENTRYPOINT ["/usr/bin/prometheus"]
USER 65534:65534
"""


def has(engine, image):
    """Whether the engine holds the image."""
    return engine.podman("image", "exists", image, check=False).returncode == 0


def make_bases(engine):
    """Pull the images of others where a registry answers, or make them of Debian packages."""
    images = (PYTHON, REDIS, HAPROXY, PROMETHEUS)
    wanted = [image for image in images if not has(engine, image)]
    if wanted and answers(REGISTRY):
        for image in wanted:
            engine.podman("pull", "--quiet", image, timeout_s=600)
        return "pulled"
    if PYTHON in wanted:
        engine.podman("import", _debian(engine), PYTHON, timeout_s=300)
    stages = ((REDIS, "redis"), (HAPROXY, "haproxy"), (PROMETHEUS, "prometheus"))
    for image, stage in stages:
        if image in wanted:
            path = engine.folder / "stand_ins"
            path.write_text(STAND_INS.format(python=PYTHON))
            engine.build(image, path, context=engine.folder / "run", flags=("--target", stage))
    return "made of Debian packages"


def build(engine, target):
    """Build one of our two images; seconds that it took."""
    started_s = time.monotonic()
    torch = () if answers(TORCH_INDEX) else ("--build-arg", "TORCH_INDEX=")
    ignored = ROOT / "deploy/Dockerfile.dockerignore"
    flags = ("--target", target, "--ignorefile", ignored, *torch)
    engine.build(f"dextouch:{target}", ROOT / "deploy/Dockerfile", context=ROOT, flags=flags)
    return time.monotonic() - started_s


def _debian(engine):
    """A minimal Debian with Python as a tar file; kept, since making it takes minutes."""
    if not DEBIAN.is_file():
        program = shutil.which("mmdebstrap")
        assert program, "no registry answers: apt-get install mmdebstrap to make a base image"
        DEBIAN.parent.mkdir(parents=True, exist_ok=True)
        partial = DEBIAN.with_suffix(".partial.tar")
        words = (program, "--quiet", "--variant=minbase", f"--include={PACKAGES}")
        engine.run("nice", "-n", "10", *words, "bookworm", partial, timeout_s=900)
        partial.rename(DEBIAN)
    return DEBIAN
