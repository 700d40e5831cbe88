"""`import lodelight`: its names, and what they cost."""

import subprocess
import sys

import lodelight

NAMES = {"Localizer", "LocalizerConfig", "Slam", "SlamConfig", "__version__", "load_map", "open_source"}


def test_public_names_are_the_stated_ones():
    assert set(lodelight.__all__) == NAMES
    assert set(dir(lodelight)) == NAMES


def test_every_public_name_is_there():
    for name in NAMES:
        assert getattr(lodelight, name) is not None


def test_import_is_free_of_slow_modules():
    code = "import sys, lodelight; print(sorted({'numpy', 'numba', 'cv2', 'scipy', 'typer'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
