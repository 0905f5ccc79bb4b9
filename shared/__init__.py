"""Not a package: only an import root. A second copy of `dextouch` under another name is a bug."""

raise ImportError(
    "import `dextouch`, not `shared.dextouch`: the folder `shared` is only an import root"
)
