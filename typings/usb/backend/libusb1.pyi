from ctypes import CDLL

from usb.backend import IBackend

class _LibUSB(IBackend):
    lib: CDLL
    def __init__(self, lib: CDLL) -> None: ...

def get_backend() -> _LibUSB | None: ...
