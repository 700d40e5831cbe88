"""What was used once is given back."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

CODE = """
import numpy as np
from lodelight.memory import give_back_large, resident_bytes

np.ones(30 << 20, np.uint8)  # from then on malloc would keep the room of arrays up to that size
give_back_large()
pairs = [(np.ones(4 << 20, np.uint8), np.ones(64 << 10, np.uint8)) for _ in range(40)]
most = resident_bytes()
small = [pair[1] for pair in pairs]
del pairs
print(most - resident_bytes())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's malloc is meant")
def test_large_arrays_that_are_freed_go_back_to_the_system_though_small_ones_stay_between_them():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 35 * (4 << 20)
