"""An installed lerobot, written for Python 3.12 → one that Python 3.11 imports.

Run once by `make_venv.sh`, with the interpreter of the benchmark's own environment. It translates
the few lines of Python 3.12 syntax (type parameters, `type` statements) into what they stand for,
and, where no torchvision is installed, puts importable stand-ins in its place: torchvision has no
build for this CPU-only torch, and neither the writer nor the reader of a dataset calls it.
"""

import importlib.util
import re
import sys
import sysconfig
import textwrap
from pathlib import Path

_ALIAS = re.compile(r"^type (\w+) = ", re.MULTILINE)
_GENERIC = re.compile(
    r"^(?P<above>(?:@.*\n)*)(?P<head>(?:class|def|async def) \w+)\[(?P<names>[^\]]+)\]"
    r"(?P<bases>\([^)]*\))?(?P<colon>:?)",
    re.MULTILINE,
)

_TORCHVISION = {
    "__init__.py": "from torchvision import io, transforms\n",
    "io.py": """
        def decode_image(*args, **kwargs):
            raise NotImplementedError("stand-in for torchvision: no images are decoded here")


        encode_jpeg = decode_image
        """,
    "transforms/__init__.py": """
        from torchvision.transforms import functional, v2


        class ToTensor:
            def __call__(self, image):
                raise NotImplementedError("stand-in for torchvision: images come as videos")
        """,
    "transforms/functional.py": "",
    "transforms/v2/__init__.py": """
        from torchvision.transforms.v2 import functional


        class Transform:
            pass


        class Compose(Transform):
            pass


        class Identity(Transform):
            pass
        """,
    "transforms/v2/functional.py": "",
}


def translate(source: str) -> str:
    """Python 3.12 source with type parameters → the same for Python 3.11.

    Only what lerobot 0.6.1 uses: `type X = …`, and type parameters on top-level classes and
    functions.
    """
    return _GENERIC.sub(_without_parameters, _ALIAS.sub(r"\1 = ", source))


def _without_parameters(match: re.Match[str]) -> str:
    variables, lines = [], ["import typing\n"]
    for parameter in match["names"].split(","):
        name, _, bound = (part.strip() for part in parameter.partition(":"))
        variables.append(name)
        limit = f", bound={bound}" if bound else ""
        lines.append(f'{name} = typing.TypeVar("{name}"{limit})\n')
    signature = match["bases"] or ""
    if match["head"].startswith("class"):
        bases = [base for base in signature.strip("()").split(",") if base.strip()]
        generic = f"typing.Generic[{', '.join(variables)}]"
        signature = f"({', '.join([*bases, generic])})"
    return "".join([*lines, match["above"], match["head"], signature, match["colon"]])


def translate_package(folder: Path) -> int:
    """Rewrite each file that this Python cannot compile; the number of files comes back.

    Raises:
        SyntaxError: a file that does not compile after the translation either.
    """
    changed = 0
    for path in sorted(folder.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        try:
            compile(source, str(path), "exec")
        except SyntaxError:
            source = translate(source)
            compile(source, str(path), "exec")
            path.write_text(source, encoding="utf-8")
            changed += 1
    return changed


def put_torchvision(packages: Path) -> None:
    """Write the stand-ins for torchvision below a site-packages folder."""
    for name, source in _TORCHVISION.items():
        path = packages / "torchvision" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(source).lstrip("\n"), encoding="utf-8")


def main() -> None:
    """Prepare the environment of the running interpreter."""
    packages = Path(sysconfig.get_paths()["purelib"])
    count = translate_package(packages / "lerobot")
    sys.stdout.write(f"lerobot: {count} files translated to Python 3.11\n")
    if importlib.util.find_spec("torchvision") is None:
        put_torchvision(packages)
        sys.stdout.write("torchvision: import stand-ins written\n")


if __name__ == "__main__":
    main()
