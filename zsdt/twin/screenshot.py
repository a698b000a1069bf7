"""Opens a recording in the Rerun viewer without a window and takes its picture.

`python -m zsdt.twin.screenshot RECORDING.rrd PICTURE.png [--at SECONDS]`
"""

from __future__ import annotations

import argparse
import os
import socket
import sys
import time
from pathlib import Path

from rerun.experimental import ViewerClient

from zsdt.errors import DataError, ZsdtError
from zsdt.files import atomic_path

SETTLE = 12.0  # s: loading, laying out, and the viewer's notices going away


def take_picture(
    recording: str | os.PathLike[str], picture: str | os.PathLike[str], at: float | None = None, settle: float = SETTLE
) -> None:
    """Saves what the viewer shows of `recording`, with the time cursor `at` seconds (its start if not given), as PNG.

    Raises: DataError where there is no such recording or no graphics adapter, real or in software.
    """
    if not Path(recording).is_file():
        raise DataError(f"There is no recording {recording}; evaluate with recordings first.")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    beside_python = Path(sys.executable).with_name("rerun")  # a virtual environment need not be on the PATH
    try:
        viewer = ViewerClient.spawn(
            headless=True,
            port=port,
            hide_welcome_screen=True,
            detach_process=False,
            executable_path=str(beside_python) if beside_python.exists() else None,
        )
    except Exception as error:  # the client raises plain errors of many kinds when the viewer dies at its start
        raise DataError(
            "The Rerun viewer did not start without a window; it needs a graphics driver, "
            f"for example the software one in Debian's mesa-vulkan-drivers ({error})."
        ) from error
    with viewer:
        viewer.open(str(Path(recording).resolve()))
        time.sleep(settle / 2)
        viewer.set_time("time", duration=0.0 if at is None else at, play_state="paused")
        time.sleep(settle / 2)
        content = viewer.take_screenshot()
    with atomic_path(picture) as beside:
        beside.write_bytes(content)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsdt.twin.screenshot", description=__doc__.splitlines()[0])
    parser.add_argument("recording", help=".rrd file")
    parser.add_argument("picture", help=".png file to write")
    parser.add_argument("--at", type=float, help="time cursor in seconds")
    options = parser.parse_args(arguments)
    try:
        take_picture(options.recording, options.picture, options.at)
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
