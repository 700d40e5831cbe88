"""What several test files need."""

from __future__ import annotations

import os
from pathlib import Path

# Small dense algebra: one BLAS thread is faster, and its bytes repeat. Before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# The first example of many a test compiles a kernel; none may fail for taking its time. In CI the examples are the same
# every time, so that a change is judged by itself; elsewhere they are new ones, which is how they find something.
settings.register_profile("lodelight", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, database=None)
settings.load_profile("ci" if os.environ.get("CI") else "lodelight")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared_data(name: str) -> Path:
    """A real recording beside the checkout; the test skips where it is not there."""
    path = SHARED_DATA / name
    if not path.exists():
        pytest.skip(f"needs the recording {name}, expected in {path}")
    return path
