class ListPortInfo:
    device: str
    serial_number: str | None

def comports(include_links: bool = False) -> list[ListPortInfo]: ...
