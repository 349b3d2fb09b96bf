"""Processes that tests send signals to."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from typing import Any

# In short sleeps: a signal that arrives just before a sleep is handled after it.
_STALL = """
import time

def stall(seconds=60):
    print("now")
    for _ in range(10 * seconds):
        time.sleep(0.1)
"""


def start(body: str, *arguments: object, **options: Any) -> subprocess.Popen[str]:
    """Run code in a process up to its word "now"; `stall()` says it and waits for a signal."""
    process = subprocess.Popen(
        [sys.executable, "-c", _STALL + textwrap.dedent(body), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        **options,
    )
    assert process.stdout is not None
    assert any("now" in line for line in process.stdout)
    return process
