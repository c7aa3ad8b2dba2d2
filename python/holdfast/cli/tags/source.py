"""Reads tags for a command, and records what it reads."""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import answers
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options import device
from holdfast.cli.tags.recording import NotARecording, Recording
from holdfast.client.tag_reading import TagReader

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from holdfast.cli.tags.options import Selection
    from holdfast.cli.tags.selection import TaggedDevice
    from holdfast.client import SyncClient
    from holdfast.client.tag_reading import Reading
    from holdfast.tags import Tag


class RecordingFailed(click.ClickException):
    """The recording can't be written. Ends the command, when its screen is closed."""

    exit_code = ExitCode.FAILED

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self._context = click.get_current_context()

    def show(self, file: Any = None) -> None:
        """Prints the error."""
        with self._context.scope(cleanup=False):
            if answers.wanted():
                answers.print_wrong("file", self.message)
            else:
                click.echo(f"holdfast: {self.message}", err=True, file=file)


class TagSource:
    """A device that is read by tags."""

    def __init__(
        self,
        of: TaggedDevice,
        client: SyncClient,
        reader: TagReader,
        recording: Recording | None,
        file: Path | None,
    ) -> None:
        self.where = f"{of.url}, unit {of.unit}"
        self.url = of.url
        self.unit = of.unit
        self.tags: Sequence[Tag] = reader.tags
        self._client = client
        self._reader = reader
        self._recording = recording
        self._file = file

    def read(self, between: Callable[[], object] = lambda: None) -> tuple[float, list[Reading]]:
        """Reads and records all tags. Returns the time and the readings.

        `between` is called after every request. Raises `RecordingFailed`.
        """
        readings = self._reader.read(self._client, between)
        moment = time.time()
        if self._recording is not None:
            try:
                self._recording.add(moment, readings)
            except OSError as error:
                raise RecordingFailed(f"{self._file}: {error.strerror}") from error
        return moment, readings

    def listen(self, tag: Tag) -> None:
        """Waits for a late reply, after the read of this tag has timed out."""
        device.await_late_reply(self._client, tag.area, tag.address)


@contextlib.contextmanager
def opened(of: TaggedDevice, selection: Selection) -> Iterator[TagSource]:
    """A source, with its connection and recording. Raises `click.UsageError`."""
    with contextlib.ExitStack() as closing:
        recording, record = None, selection.record
        if record is not None:
            recording = _recording(record, of)
            closing.callback(recording.close)
            if recording.removed:
                click.echo(f"{record}: removed an incomplete last line", err=True)
        client = closing.enter_context(device.connect(of.url, of.unit, of.timeout))
        reader = TagReader(of.tags, max_gap=selection.max_gap)
        yield TagSource(of, client, reader, recording, record)


def _recording(file: Path, of: TaggedDevice) -> Recording:
    try:
        return Recording(file, of.tags)
    except (OSError, NotARecording) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise click.UsageError(f"{file}: {reason}") from error
