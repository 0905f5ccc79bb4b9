"""The TLS proxies of `deploy`, as processes on free ports, with their own certificates."""

import re
import socket
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

from tests.programs import needed_program

DEPLOY = Path(__file__).parents[2] / "deploy"
NAMES = ("dashboard.lab", "store.lab", "desk-1.lab", "desk-2.lab")
# The ports of the examples, by the name of the host.
PORTS = dict(zip(NAMES, (8080, 8081, 8083, 8093), strict=True))
START_TIMEOUT_S = 60


def trusted_certificates(folder, monkeypatch):
    """Write a certificate of all names, whose authority every client of this process trusts."""
    folder.mkdir()

    def openssl(*words):
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    newkey = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    authority = ("-addext", "basicConstraints=critical,CA:TRUE", "-addext", "keyUsage=keyCertSign")
    openssl(
        "req",
        "-x509",
        *newkey,
        "-keyout",
        "ca.key",
        "-out",
        "ca.pem",
        "-subj",
        "/CN=lab",
        *authority,
    )
    openssl("req", *newkey, "-keyout", "key.pem", "-out", "csr.pem", "-subj", "/CN=dashboard.lab")
    names = ",".join(f"DNS:{name}" for name in NAMES)
    (folder / "names").write_text(f"subjectAltName={names}\nauthorityKeyIdentifier=keyid\n")
    signed = ("-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", "names")
    openssl("x509", "-req", "-in", "csr.pem", "-out", "fullchain.pem", *signed)
    monkeypatch.setenv("SSL_CERT_FILE", str(folder / "ca.pem"))
    resolve = socket.getaddrinfo

    def lab_names_are_here(host, *given, **named):
        is_lab = (host.decode() if isinstance(host, bytes) else host) in NAMES
        return resolve("127.0.0.1" if is_lab else host, *given, **named)

    monkeypatch.setattr(socket, "getaddrinfo", lab_names_are_here)


def _nginx(folder, port, http_port):
    program = needed_program("nginx", package="nginx")
    text = (DEPLOY / "nginx/dextouch.conf").read_text()
    text = text.replace("listen 443 ", f"listen {port} ").replace(
        "listen 80;", f"listen {http_port};"
    )
    include = (
        (DEPLOY / "nginx/dextouch_proxy.inc").read_text().replace("/etc/ssl/dextouch", str(folder))
    )
    (folder / "dextouch_proxy.inc").write_text(include)
    text = text.replace("/etc/nginx", str(folder))
    temporary = "".join(
        f"{kind}_temp_path {folder}/{kind};\n"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    head = f"pid {folder}/nginx.pid; daemon off; error_log stderr warn; events {{}}\n"
    text = f"{head}http {{ access_log off; {temporary}{text} }}"
    return text, [program, "-p", str(folder), "-c", str(folder / "proxy.conf"), "-e", "stderr"]


def _caddy(folder, port, http_port):
    program = needed_program("caddy", package="caddy")
    text = (DEPLOY / "caddy/Caddyfile").read_text().replace("/etc/ssl/dextouch", str(folder))
    text = f"{{\nadmin off\nhttps_port {port}\nhttp_port {http_port}\n}}\n{text}"
    words = ["run", "--config", str(folder / "proxy.conf"), "--adapter", "caddyfile"]
    return text, [program, *words]


KINDS = {"nginx": _nginx, "caddy": _caddy}


@contextmanager
def running_proxy(kind, folder, urls, port, http_port):
    """Run an example with other ports and paths: `urls` of services by the name of their host."""
    text, command = KINDS[kind](folder, port, http_port)
    for name, url in urls.items():
        text, count = re.subn(rf"127\.0\.0\.1:{PORTS[name]}\b", url.removeprefix("http://"), text)
        assert count == 1
    (folder / "proxy.conf").write_text(text)
    environment = {"HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    with (folder / "proxy.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
    try:
        end_s = time.monotonic() + START_TIMEOUT_S
        while True:
            is_over = process.poll() is not None or time.monotonic() > end_s
            assert not is_over, (folder / "proxy.log").read_text()
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait(START_TIMEOUT_S)
