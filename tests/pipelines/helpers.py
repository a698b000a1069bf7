"""Starting the fake command line as a user would, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

APP = Path(__file__).parent / "fake_app.py"


def command(outputs: Path, *arguments: str) -> list[str]:
    """Words of the command line."""
    return [sys.executable, str(APP), f"machine.outputs={outputs}", *arguments]


def environment() -> dict[str, str]:
    """Environment of the user without what the test runner has put into it."""
    return {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST", "HYDRA"))}


def start(outputs: Path, *arguments: str) -> subprocess.Popen[str]:
    """Starts a command in a process group of its own."""
    return subprocess.Popen(
        command(outputs, *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        start_new_session=True,
        cwd=outputs,
    )


def run(outputs: Path, *arguments: str) -> tuple[int, str, str]:
    """Runs a command to its end: exit code, stdout, stderr."""
    process = start(outputs, *arguments)
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


def builds(outputs: Path) -> list[str]:
    """What was really built so far, in order."""
    trace = outputs / "builds.txt"
    return trace.read_text().splitlines() if trace.exists() else []
