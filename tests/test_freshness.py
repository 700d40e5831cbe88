"""A kernel is compiled anew when a kernel in another file that it calls has changed."""

from __future__ import annotations

import subprocess
import sys


def test_a_changed_leaf_reaches_the_kernels_that_call_it(tmp_path):
    package = tmp_path / "tree"
    package.mkdir()
    (package / "__init__.py").touch()
    head = "from lodelight.compiled import kernel\n"
    (package / "branch.py").write_text(
        head + "from tree.leaf import (\n    leaf,\n)\n\n\n@kernel\ndef branch(x):\n    return leaf(x) + 1\n"
    )

    def run(leaf: str) -> tuple[str, int]:
        (package / "leaf.py").write_text(head + f"\n\n@kernel\ndef leaf(x):\n    return {leaf}\n")
        show = "from tree.branch import branch; print(branch(1.0), sum(branch.stats.cache_hits.values()))"
        done = subprocess.run([sys.executable, "-c", show], cwd=tmp_path, capture_output=True, text=True, check=True)
        value, hits = done.stdout.split()
        return value, int(hits)

    assert run("10.0 * x") == ("11.0", 0)
    assert run("10.0 * x") == ("11.0", 1)  # and it is not compiled for nothing
    assert run("20.0 * x") == ("21.0", 0)
