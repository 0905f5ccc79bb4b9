"""A command in, what it printed on a Debian kernel of its own out: qemu without KVM.

The host's files are the machine's files, read-only, so the command runs with the project's own
environment. Kernel and modules come from Debian's package, unpacked and never installed.
"""

import re
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

QEMU = "qemu-system-x86_64"
TOOLS = (QEMU, "apt-cache", "apt-get", "dpkg-deb", "depmod", "modprobe", "cpio", "busybox")
# What the first process needs to reach the host's files; all else is loaded from there.
FIRST_MODULES = ("virtio_pci", "9pnet_virtio", "9p")
ENDED = re.compile(r"VM: ended with (\d+)")
MEMORY_MIB = 2048
# The machine's clock counts a nanosecond an instruction, so that a busy host does not make it slow.
ICOUNT = "shift=0"


class MachineError(Exception):
    """The machine cannot be made, or did not come to an end."""


@dataclass(frozen=True)
class Kernel:
    """An unpacked kernel package: `root` holds `boot` and `lib/modules/RELEASE`."""

    root: Path

    @property
    def release(self) -> str:
        """Its version, as its modules' folder says."""
        return next((self.root / "lib/modules").iterdir()).name

    @property
    def image(self) -> Path:
        """What qemu boots."""
        return self.root / f"boot/vmlinuz-{self.release}"


def missing_tools() -> list[str]:
    """Programs of this suite that this machine lacks."""
    return [tool for tool in TOOLS if shutil.which(tool) is None]


def fetch_kernel(folder: Path) -> Kernel:
    """Debian's kernel for this architecture, downloaded once and kept.

    Raises:
        MachineError: no package can be had.
    """
    root = folder / "kernel"
    if not (root / "complete").is_file():
        shutil.rmtree(root, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        listed = _run(["apt-cache", "depends", "linux-image-amd64"], folder)
        found = re.search(r"Depends: (linux-image-\S+)", listed)
        if found is None:
            raise MachineError("apt knows no kernel behind linux-image-amd64; apt-get update?")
        _run(["apt-get", "download", found[1]], folder)
        (package,) = folder.glob(f"{found[1]}_*.deb")
        _run(["dpkg-deb", "-x", str(package), str(root)], folder)
        package.unlink()
        _run(["depmod", "-b", str(root), Kernel(root).release], folder)
        (root / "complete").touch()
    return Kernel(root)


def make_first_files(kernel: Kernel, script: Path, folder: Path) -> Path:
    """The machine's first file system: busybox, `init.sh`, a few modules, the script's name."""
    tree = folder / "initramfs"
    shutil.rmtree(tree, ignore_errors=True)
    (tree / "bin").mkdir(parents=True)
    (tree / "modules").mkdir()
    busybox = shutil.which("busybox")
    if busybox is None:
        raise MachineError("busybox is missing")
    shutil.copy(busybox, tree / "bin/busybox")
    shutil.copy(Path(__file__).with_name("init.sh"), tree / "init")
    (tree / "init").chmod(0o755)
    (tree / "script").write_text(str(script))
    names: list[str] = []
    for module in FIRST_MODULES:
        flags = ["-d", str(kernel.root), "-S", kernel.release, "--show-depends", module]
        for line in _run(["modprobe", *flags], folder).splitlines():
            path = Path(line.split()[1])
            if path.name not in names:
                names.append(path.name)
                shutil.copy(path, tree / "modules")
    (tree / "modules/order").write_text("\n".join(names) + "\n")
    listing = "\n".join(str(path.relative_to(tree)) for path in sorted(tree.rglob("*")))
    packed = subprocess.run(
        ["cpio", "-o", "-H", "newc", "--quiet"],
        cwd=tree, input=listing.encode(), stdout=subprocess.PIPE, check=True,
    )  # fmt: skip
    target = folder / "initramfs.cpio"
    target.write_bytes(packed.stdout)
    return target


def run_in_machine(
    commands: list[str], *, folder: Path, timeout_s: float, environment: dict[str, str]
) -> tuple[int, str]:
    """Run shell commands on the kernel; exit status of the last, and the whole console.

    The console can be followed in `console.log` of the folder.

    Args:
        commands: lines of a shell script; it ends with the first that fails.
        folder: keeps the kernel, and the files of this run.
        timeout_s: after which the machine is killed.
        environment: variables of the commands.

    Raises:
        MachineError: the machine did not come to an end by itself.
    """
    kernel = fetch_kernel(folder)
    exports = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
    script = folder / "script.sh"
    header = ["set -e", f"export VM_KERNEL={shlex.quote(str(kernel.root))}"]
    script.write_text("\n".join([*header, *exports, *commands]) + "\n")
    command = [
        QEMU, "-accel", "tcg", "-cpu", "max", "-m", str(MEMORY_MIB), "-smp", "1", "-icount", ICOUNT,
        "-nographic", "-no-reboot", "-nic", "none", "-kernel", str(kernel.image),
        "-initrd", str(make_first_files(kernel, script, folder)),
        "-append", "console=ttyS0 quiet panic=-1",
        "-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap",
    ]  # fmt: skip
    log = folder / "console.log"
    ran_out = False
    with log.open("wb") as file:
        try:
            subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                timeout=timeout_s, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            ran_out = True
    console = log.read_bytes().decode(errors="replace").replace("\r\n", "\n")
    if ran_out:
        raise MachineError(f"the machine did not end within {timeout_s} s; it said:\n{console}")
    ended = ENDED.findall(console)
    if not ended:
        raise MachineError(f"the machine broke off; it said:\n{console}")
    return int(ended[-1]), console


def _run(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise MachineError(f"{' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout
