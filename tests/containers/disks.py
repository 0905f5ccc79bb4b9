"""Small disks for the volumes of containers, which a test fills up and frees again."""

import os

OWNER = "10001:10001"
STEP_BYTES = 1 << 16


class Disk:
    """An ext4 file system in a sparse file, mounted in the engine's folder.

    Args:
        engine: whose folder holds it.
        name: of the folder.
        num_bytes: its size; the file takes what is written only.
    """

    def __init__(self, engine, name, num_bytes):
        self._engine = engine
        self.place = engine.folder / "disks" / name
        self.place.mkdir(parents=True, exist_ok=True)
        self._image = self.place.with_suffix(".img")
        self._image.unlink(missing_ok=True)
        with self._image.open("wb") as image:
            image.truncate(num_bytes)
        # As an administrator makes a disk for the services, with its folder lost+found.
        engine.run("mkfs.ext4", "-q", "-m", "0", "-E", f"root_owner={OWNER}", self._image)
        engine.run("mount", "-o", "loop", self._image, self.place)
        self._ballast = self.place / "lost+found" / "ballast"

    @property
    def mounted(self):
        """Flags of podman that mount it as the volume of its name."""
        return "--volume", f"{self.place}:/data/{self.place.name}"

    def free_bytes(self):
        disk = os.statvfs(self.place)
        return disk.f_bavail * disk.f_frsize

    def fill(self, *, leave_bytes=0):
        """Take all space but `leave_bytes`."""
        descriptor = os.open(self._ballast, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        try:
            while (more := self.free_bytes() - leave_bytes) > 0:
                # Large steps first; what is left then is less than a step and its metadata.
                size = more if more < STEP_BYTES else more // 2
                os.posix_fallocate(descriptor, os.fstat(descriptor).st_size, size)
        except OSError:
            # Others wrote as well; there is nothing left now.
            pass
        finally:
            os.close(descriptor)

    def free(self):
        """Give back what `fill` took."""
        self._ballast.unlink(missing_ok=True)

    def close(self):
        self._engine.run("umount", "--lazy", self.place, check=False)
        self._image.unlink()
