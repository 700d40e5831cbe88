"""When a cached kernel is out of date: its file has changed, or one that it builds on.

numba compares a kernel's own file only, while code and constants of the kernels it calls are compiled into it. So an
upgrade that touches a leaf would go on running the old leaf inside every kernel whose file stayed the same.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

_IMPORT = re.compile(r"^ *from +([\w.]+) +import +(\([^)]*\)|[^\n]*)", re.MULTILINE)


@cache
def source_stamp(module: str, file: str) -> str:
    """Hash of a module's source and of all that it imports, directly or not, from its own package.

    module : dotted name; file : where it is
    """
    package = module.partition(".")[0]
    root = Path(file).parents[module.count(".")]
    found: dict[Path, bytes] = {}
    waiting = [Path(file)]
    while waiting:
        path = waiting.pop()
        if path in found or not path.is_file():
            continue
        found[path] = path.read_bytes()
        for origin, names in _IMPORT.findall(found[path].decode()):
            if origin.partition(".")[0] == package:
                base = root.joinpath(*origin.split("."))
                waiting.append(base.with_suffix(".py"))
                waiting.extend(base / f"{name}.py" for name in re.findall(r"\w+", names))
    digest = hashlib.sha256()
    for path in sorted(found):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + found[path] + b"\0")
    return digest.hexdigest()
