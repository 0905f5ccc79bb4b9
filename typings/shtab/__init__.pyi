from argparse import ArgumentParser

FILE: dict[str, str]
DIRECTORY: dict[str, str]

def complete(parser: ArgumentParser, shell: str = ...) -> str: ...
