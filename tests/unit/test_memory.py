"""What is said of memory."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from deepclouds.memory import gib, peak_bytes


def test_a_peak_is_the_processs_own() -> None:
    """A program that a large process starts has not been large itself, and what it takes afterwards counts though it is given back."""
    ballast = np.ones(2**27)
    assert peak_bytes() > ballast.nbytes
    code = "import numpy as np; from deepclouds.memory import peak_bytes; a = peak_bytes(); np.ones(2**25); print(a, peak_bytes())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = (int(word) for word in done.stdout.split())
    assert before < 0.5 * ballast.nbytes
    assert after - before > 0.9 * 2**28


def test_bytes_in_words() -> None:
    assert gib(5 * 2**28) == "1.25 GiB"
    assert gib(12 * 2**20) == "12 MiB"
