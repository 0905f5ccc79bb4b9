"""Fetch vendored files of npm packages again, by the versions in `vendored.json` of a folder."""

import hashlib
import json
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path


def main() -> int:
    """Fetch every package, write its files and record their hashes."""
    folder = Path(sys.argv[1])
    record = folder / "vendored.json"
    packages = json.loads(record.read_text(encoding="utf-8"))
    for package in packages:
        with tempfile.TemporaryDirectory() as scratch:
            name = f"{package['package']}@{package['version']}"
            subprocess.run(  # noqa: S603 - name and version are those of the record
                ["npm", "pack", "--silent", name],  # noqa: S607
                cwd=scratch,
                check=True,
            )
            (archive,) = Path(scratch).glob("*.tgz")
            with tarfile.open(archive) as packed:
                for target, source in package["files"].items():
                    member = packed.extractfile(source)
                    if member is None:
                        print(f"{name}: no file {source}", file=sys.stderr)  # noqa: T201
                        return 1
                    (folder / target).parent.mkdir(parents=True, exist_ok=True)
                    (folder / target).write_bytes(member.read())
        package["sha256"] = {
            target: hashlib.sha256((folder / target).read_bytes()).hexdigest()
            for target in package["files"]
        }
    record.write_text(json.dumps(packages, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
