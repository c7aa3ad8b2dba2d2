"""The values of tags: from the native poller to the outputs, on a thread of its own.

It handles polls in short turns, so that nobody waits long for its lock. If it can't keep up, it
rests between turns, because outputs need the processor too; polls stay in the poller, which drops
the oldest.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from holdfast.appliance.parts.native_links import destination
from holdfast.client.url import NetworkTarget
from holdfast.config.models.devices import DeviceIdentityConfig
from holdfast.events import log_lines
from holdfast.outputs import Buffer, Changes, OutputSender, log_unsent
from holdfast.outputs.device_access import DeviceInfo
from holdfast.outputs.line_protocol import has_field
from holdfast.polling import Reading
from holdfast.polling.readings import Reader
from holdfast.runtime import standstill
from holdfast.runtime.heartbeat import Heartbeat

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from holdfast._core import PollReceiver
    from holdfast.config import Config
    from holdfast.config.models.devices import DeviceConfig
    from holdfast.config.models.outputs import Output
    from holdfast.outputs import Receiver
    from holdfast.outputs.buffer_file import BufferFile
    from holdfast.polling import DevicePoll
    from holdfast.tags import Tag
    from holdfast.types import PolledBlock, ThreadHeartbeat

_WAIT_S = 1.0
"""How long one wait for polls takes."""

_GATHER_S = 0.005
"""How long a batch waits for more polls, so that batches have a useful size."""


_TURN_S = 0.01
"""Time of polls that are handled while others wait for the lock."""

_YIELD_S = 0.001
"""Time between two turns, in which others get the lock."""

_LATE_S = 1.0
"""Age of a poll from which on the thread rests between turns as long as they take."""

Poll: TypeAlias = "tuple[str, float, list[PolledBlock]]"
"""`reported_as` of the device, the scheduled time in seconds, and the blocks: none if another node
polls it now."""


def _is_late(poll: Poll) -> bool:
    _, _, blocks = poll
    return bool(blocks) and time.time() - blocks[-1][5] > _LATE_S


def _info(device: DeviceConfig) -> DeviceInfo:
    identity, target = device.identity or DeviceIdentityConfig(), device.target
    return DeviceInfo(
        f"{target}, unit {device.unit}",
        target.host if isinstance(target, NetworkTarget) else None,
        identity.vendor_name,
        identity.model_name or device.profile,
        identity.revision,
    )


class TaggedDevice(NamedTuple):
    """A device with tags, which a reload replaces if they or their source change."""

    source: object
    """Its connection and its unit id: with others, it is another machine."""
    reader: Reader
    reported_as: str
    """Its name in polls, which is another one after a change of what is read: polls may be late."""

    @property
    def contents(self) -> tuple[object, object, Mapping[str, object]]:
        """What is read: the source, the parts of long tags, each tag's place and meaning."""
        tags = self.reader.named.items()
        meanings = {name: tag.place_and_meaning for name, tag in tags}
        return self.source, self.reader.cut, meanings


def _identities(tagged: Mapping[str, TaggedDevice]) -> set[tuple[str, str]]:
    return {(name, device.reported_as) for name, device in tagged.items()}


def _kept(poll: DevicePoll, before: TaggedDevice, now: TaggedDevice | None) -> list[Reading]:
    """What a reload leaves of a poll: the readings of the same machine that mean the same."""
    if now is before:
        return poll.readings
    if now is None or now.source != before.source:
        return []
    tags = now.reader.named
    return [
        reading._replace(tag=tag)
        for reading in poll.readings
        if (tag := tags.get(reading.name)) is not None
        and tag.place_and_meaning == reading.tag.place_and_meaning
    ]


@dataclass
class _Output:
    """What an output publishes, and what it has not sent yet."""

    settings: Output
    changes: Changes
    buffer: Buffer

    def offer(self, polls: Iterable[DevicePoll]) -> None:
        """Offers what is published of the polls of devices."""
        only = self.settings.devices
        offered = []
        for poll in polls:
            if only is not None and poll.device not in only:
                continue
            if poll.is_standby:  # Another node publishes until this one has the lease again.
                self.changes.forget([poll.device])
            readings = self.changes.of(poll.readings)
            if self.settings.is_line_protocol:
                # Nothing would be sent of them, but they would count as sent.
                readings = [each for each in readings if has_field(each.value)]
            offered.append(readings)
        self.buffer.offer(offered)


class TagValues:
    """Converts the polls that a receiver takes, and offers them to each output.

    Ends with the poller.
    """

    def __init__(self, results: PollReceiver) -> None:
        self.results = results
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._tagged: dict[str, TaggedDevice] = {}
        self._readers: dict[str, Reader] = {}
        """By the name in polls."""
        self._outputs: dict[str, _Output] = {}
        self._latest: dict[str, tuple[DevicePoll, float]] = {}
        """The last poll of each device, and by how much the clock was ahead of `standstill.now`
        when it came."""
        self._answering: dict[str, bool] = {}
        self.standby: frozenset[str] = frozenset()
        """The devices with tags that another node polls. Replaced as a whole."""
        self.revision = 0
        """Changes with the tags of any device, and with `devices`."""
        self.devices: dict[str, DeviceInfo] = {}
        """What is known of each device with tags. Replaced as a whole."""
        self.retained: dict[tuple[str, str], str] = {}
        """Of each broker and topic that it retains, the output that published it: see `Site`."""
        self.answers = 0
        """Changes when a device stops answering, or answers again."""
        self._heartbeat = Heartbeat()
        self._stopping = threading.Event()
        self._reported_dropped = 0
        """How many of the dropped polls were logged."""
        self._thread = threading.Thread(target=self._run, name="holdfast-tags", daemon=True)

    def start(self) -> None:
        """Starts the thread, if it does not run yet."""
        if self._thread.ident is None:
            self._thread.start()

    def stop(self) -> None:
        """Offers nothing from now on: outputs end one by one, and all get the same values."""
        with self._lock:
            self._stopping.set()

    def join(self, timeout: float) -> None:
        """Waits for the thread, which ends with the poller. Called after the end of all outputs."""
        self.stop()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        for name, output in self._outputs.items():
            log_unsent(name, output.buffer)

    def tagged(self, config: Config, changed: Collection[str]) -> dict[str, TaggedDevice]:
        """The devices with tags, for `adopt`. Those of which other settings have changed stay."""
        found: dict[str, TaggedDevice] = {}
        for name, device in config.devices.items():
            if not device.is_polled or not len(tags := config.tags(name)):
                continue
            known = self._tagged.get(name)
            if known is None or name in changed:
                source = destination(config, name)
                reader = Reader(name, tags, device.max_registers, device.max_bits)
                now = TaggedDevice(source, reader, f"{name}#{next(self._numbers)}")
                if known is None or known.contents != now.contents:
                    known = now
                elif known.reader.tags != reader.tags:  # Other limits, or another description.
                    known = known._replace(reader=reader)
            found[name] = known
        return found

    def adopt(self, config: Config, tagged: dict[str, TaggedDevice]) -> set[str]:
        """Takes over devices and outputs. Outputs keep what they have to send.

        Returns the devices that are not as before: the values of some of their tags are unknown.
        """
        with self._lock:
            before, self._tagged = self._tagged, tagged
            changed = {name for name, _ in _identities(before) ^ _identities(tagged)}
            devices = {name: _info(config.devices[name]) for name in tagged}
            self.revision += before != tagged or devices != self.devices
            self.devices = devices
            moved = {
                name
                for name in before.keys() & tagged.keys()
                if before[name].source != tagged[name].source
            }
            # Nobody knows yet whether a new device answers, or another machine.
            answering = {
                name: self._answering.get(name, False) and name not in moved for name in tagged
            }
            self.answers += answering != self._answering
            self._answering = answering
            self.standby &= tagged.keys()
            self._readers = {each.reported_as: each.reader for each in tagged.values()}
            self._latest = {
                name: (poll._replace(readings=kept), ahead)
                for name, (poll, ahead) in self._latest.items()
                if (kept := _kept(poll, before[name], tagged.get(name)))
            }
            outputs: dict[str, _Output] = {}
            for name, settings in config.outputs.items():
                known = self._outputs.get(name)
                if known is None or known.settings != settings:
                    buffer = Buffer(before=None if known is None else known.buffer)
                    changes = Changes(settings.publish, settings.heartbeat)
                    known = _Output(settings, changes, buffer)
                known.buffer.most = settings.buffer.values
                known.changes.forget(changed)
                outputs[name] = known
            gone = {name: self._outputs[name] for name in self._outputs.keys() - outputs.keys()}
            self._outputs = outputs
        for name, output in gone.items():
            log_unsent(name, output.buffer)
        return changed & tagged.keys()

    def sending(self, name: str, receiver: Callable[[], Receiver]) -> OutputSender:
        """The adapter of an output."""
        output = self._outputs[name]
        settings = output.settings.buffer
        file = settings.file

        def opened() -> BufferFile:
            from holdfast.outputs.buffer_file import BufferFile

            assert file is not None, "called only with a file"
            return BufferFile(file, settings.max_bytes, self.find)

        def leaves() -> bool:
            return all(each.settings.buffer.file != file for each in self._outputs.values())

        def is_followed() -> bool:
            return name in self._outputs and not self._stopping.is_set()

        return OutputSender(
            name,
            receiver(),
            output.buffer,
            None if file is None else opened,
            leaves,
            is_followed,
            # With `scan`, the next poll follows what was lost.
            partial(self.renew, name) if output.settings.publish == "change" else lambda _: None,
        )

    def find(self, device: str, tag: str) -> Tag | None:
        """A tag of the configuration."""
        known = self._tagged.get(device)
        return None if known is None else known.reader.named.get(tag)

    def latest(self) -> list[Reading]:
        """The last reading of each tag. Thread-safe."""
        with self._lock:
            return [reading for poll, _ in self._latest.values() for reading in poll.readings]

    def latest_with_ages(self) -> list[tuple[Reading, float]]:
        """The same, each with its age in seconds, also after the clock was set, or a suspend.
        Thread-safe.
        """
        with self._lock:
            now = standstill.now()
            return [
                (reading, max(0.0, now + ahead - reading.time))
                for poll, ahead in self._latest.values()
                for reading in poll.readings
            ]

    def tags(self) -> dict[str, tuple[Tag, ...]]:
        """The tags of each device. Thread-safe."""
        with self._lock:
            tagged = self._tagged
        return {name: device.reader.tags for name, device in tagged.items()}

    def answering(self) -> dict[str, bool]:
        """Whether each device answers: none does before its first poll. Thread-safe."""
        with self._lock:
            return dict(self._answering)

    def refresh(self, output: str) -> None:
        """Offers the last value of each tag to an output again. Thread-safe."""
        with self._lock:
            if (known := self._outputs.get(output)) is not None and not self._stopping.is_set():
                known.changes.forget(self._tagged)
                known.offer(poll for poll, _ in self._latest.values())

    def renew(self, output: str, tags: Collection[tuple[str, str]] | None) -> None:
        """Does the same; with `tags` of devices, has their next values published. Thread-safe."""
        if tags is None:
            return self.refresh(output)
        with self._lock:
            if (known := self._outputs.get(output)) is not None:
                known.changes.forget_tags(tags)
        return None

    def heartbeat(self) -> ThreadHeartbeat | None:
        """The heartbeat of the thread; `None` before the start."""
        if self._thread.ident is None:
            return None
        return self._thread.name, self._heartbeat.age, self._thread.native_id

    @property
    def dropped(self) -> int:
        """Polls that were lost because this thread did not keep up."""
        return self.results.dropped

    def _run(self) -> None:
        while (taken := self.results.take(_WAIT_S)) is not None:
            self._heartbeat.beat()
            if not taken[0]:
                continue
            # Not a wait for the stop: on some Pythons, that follows a clock which may be set back.
            time.sleep(_GATHER_S)
            found = deque(taken[0])
            more = self.results.take(0.0)
            if more is not None:
                found += more[0]
            self._handle(found)
            if (lost := self.dropped - self._reported_dropped) > 0:
                self._reported_dropped += lost
                log_lines.limited(logging.WARNING, "tag_polls_dropped", kind="", count=lost)

    def _handle(self, found: deque[Poll]) -> None:
        while found and not self._stopping.is_set():
            self._heartbeat.beat()
            try:
                with self._lock:
                    if not self._stopping.is_set():
                        self._offer(list(self._turn(found, time.monotonic() + _TURN_S)))
            except Exception:  # A fault in one poll must not end all outputs.
                log_lines.problem("tag_values_failed")
            if found:
                time.sleep(_TURN_S if _is_late(found[0]) else _YIELD_S)

    def _turn(self, found: deque[Poll], until: float) -> Iterator[DevicePoll]:
        """Takes and converts polls until a time, at least one."""
        while found:
            reported_as, _, blocks = found.popleft()
            if (reader := self._readers.get(reported_as)) is not None:
                yield reader.poll(blocks)
            if time.monotonic() >= until:
                return

    def _offer(self, polls: Sequence[DevicePoll]) -> None:
        ahead = time.time() - standstill.now()
        for poll in polls:
            self._latest[poll.device] = poll, ahead
            if poll.is_standby is not (poll.device in self.standby):
                self.standby ^= {poll.device}
            answers = poll.has_answered
            if self._answering[poll.device] is not answers:
                self._answering[poll.device] = answers
                self.answers += 1
        for output in self._outputs.values():
            output.offer(polls)
