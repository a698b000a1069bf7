"""A recording in memory that becomes a file when it is whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import rerun as rr

from zsdt.files import atomic_path

APPLICATION = "zsdt"


@contextmanager
def new_recording(
    path: str | os.PathLike[str], identity: str, name: str, config_text: str = ""
) -> Iterator[rr.RecordingStream]:
    """Gives a stream to log to and writes `path` at the end; `config_text` (YAML) becomes the page `config`.

    identity: the same things recorded again are the same recording. Raises: DataError where the disk does not take
    the file.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=identity)
    content = rr.binary_stream(stream)  # in memory: the viewer's own file writer only warns when a disk is full
    stream.send_recording_name(name)
    text = f"```yaml\n{config_text.strip() or '# no configuration was given'}\n```"
    try:
        yield stream
        stream.log("config", rr.TextDocument(text, media_type="text/markdown"), static=True)
        written = content.read()
    finally:
        stream.disconnect()
    with atomic_path(path) as beside:
        beside.write_bytes((written or b"") + (content.read(flush=False) or b""))
