"""Backups of a log: its streams as files, and the number of servers that keep them.

A backup is a folder: `backup.json`, and one file for each stream, as the servers send it.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import os
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from nats.errors import Error, NoRespondersError

from holdfast.net import event_loop
from holdfast.net.nats.connection import connected_once, nats_reason
from holdfast.net.nats.jetstream_errors import NO_MESSAGE, STREAM_NOT_FOUND

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from pathlib import Path
    from typing import TypeVar

    from nats.aio.msg import Msg

    from holdfast.net.nats.connection import Servers
    from holdfast.net.nats.tolerant_client import SafeClient

    T = TypeVar("T")

VERSION = 1
SNAPSHOT_KEY = "snapshot"
"""The key that names the snapshots."""

NO_USABLE_BACKUP = (
    "no node could begin with the backup; try again when a node that runs has stored a new snapshot"
)

ATTEMPTS = 5
"""How often a backup is begun, at most: nodes may replace the snapshot that it begins with."""

REPLACED = (
    f"nodes have replaced the snapshot {ATTEMPTS} times before it and what follows was fetched: "
    "try again when less is written, or nearer to the servers"
)

CHUNK_BYTES = 128 * 1024
ANSWER_TIMEOUT_S = 30.0
"""Seconds within which a server must answer, or send the next part."""

LEADER_TIMEOUT_S = 10.0
"""Seconds within which servers must know where a request goes. They elect leaders, and one makes a
stream before the others know of it."""

RETRY_S = 0.1
"""Seconds between two attempts."""


class BackupFailed(Exception):
    """The message says what can't be done, and why."""


class _Replaced(BackupFailed):
    """Nodes have replaced the snapshot, or removed messages, while streams were fetched."""


class _NotFound(BackupFailed):
    """The servers don't have the stream."""


class _NoMessage(BackupFailed):
    """The stream does not have the message."""


_KINDS = {STREAM_NOT_FOUND: _NotFound, NO_MESSAGE: _NoMessage}


class _Snapshot(NamedTuple):
    """The newest snapshot of a log, and the sequence of the key that names it."""

    key: int
    sequence: int
    object: str


def streams(log: str) -> list[str]:
    """The streams of a log: the one with the key of the snapshot first, with the steps last."""
    name = f"holdfast-log-{log}"
    return [f"KV_{name}", f"OBJ_{name}", name]


def leases(log: str) -> list[str]:
    """The streams of leases, which nodes create anew: no backup has them."""
    return [f"KV_holdfast-log-{log}-leases", f"KV_holdfast-log-{log}-devices"]


def back_up(servers: Servers, log: str, folder: Path) -> int:
    """Writes a backup to a new folder. Returns the number of messages. Raises `BackupFailed`.

    What is confirmed later is not in it. Nodes may run: the newest snapshot is fetched before the
    steps that follow it, and all again if it was replaced meanwhile. A log that could not be
    rebuilt from it is refused.
    """
    try:
        folder.mkdir()
    except OSError as error:
        raise BackupFailed(f"{folder}: {error.strerror or error}") from error
    try:
        return _run(servers, lambda client: _back_up(client, log, folder))
    except BaseException:
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
        raise


def restore(servers: Servers, log: str, replicas: int, folder: Path) -> int:
    """Puts a backup on servers that don't have the log. Returns the number of messages.

    No node may run. Raises `BackupFailed`. What was restored by then is deleted again, if the
    servers can still be reached and no node seems to use it. If it is not, no node begins with it:
    the key of the snapshot, without which a log with messages is refused, is restored last, and
    deleted first.
    """
    found = _checked(folder, log)
    _run(servers, lambda client: _refuse_existing(client, log))
    confirmed: dict[str, bool] = {}
    try:
        return _run(
            servers, lambda client: _restore(client, log, replicas, folder, found, confirmed)
        )
    except BaseException as error:
        # Over a new connection: what ends a command may also end the tasks of the old one.
        try:
            left = _run(servers, lambda client: _clean_up(client, log, confirmed))
        except BackupFailed as failure:
            left = f"What was restored could not be deleted, but no node begins with it: {failure}"
        if left is None:
            raise
        raise BackupFailed(f"{str(error) or 'interrupted'}. {left}") from error


def set_replicas(servers: Servers, log: str, replicas: int) -> dict[str, tuple[int, int]]:
    """Has each stream of the log kept by so many servers. Returns the numbers before and now.

    Raises `BackupFailed`.
    """
    return _run(servers, lambda client: _set_replicas(client, log, replicas))


def _run(servers: Servers, work: Callable[[SafeClient], Coroutine[Any, Any, T]]) -> T:
    async def connected() -> T:
        async with connected_once(servers, "holdfast log") as client:
            return await work(client)

    try:
        return event_loop.run(connected())
    except (Error, OSError, TimeoutError) as error:
        raise BackupFailed(nats_reason(error)) from error


async def _ask(client: SafeClient, subject: str, request: Any = None) -> dict[str, Any]:
    """A request to JetStream. Raises `BackupFailed` with the error of the servers."""
    payload = b"" if request is None else json.dumps(request).encode()
    reply = await _request(client, f"$JS.API.{subject}", payload)
    answer: dict[str, Any] = json.loads(reply.data)
    if "error" in answer:
        error = answer["error"]
        kind = _KINDS.get(error.get("err_code"), BackupFailed)
        raise kind(str(error.get("description", error)))
    return answer


async def _request(client: SafeClient, subject: str, payload: bytes) -> Msg:
    """A request that is sent again while nobody is there to take it."""
    until = time.monotonic() + LEADER_TIMEOUT_S
    while True:
        try:
            return await client.request(subject, payload, timeout=ANSWER_TIMEOUT_S)
        except NoRespondersError as error:
            if time.monotonic() > until:
                reason = (
                    f"{subject}: nobody answers; JetStream is off, or its servers have no leader"
                )
                raise BackupFailed(reason) from error
            await asyncio.sleep(RETRY_S)


async def _config(client: SafeClient, name: str) -> dict[str, Any] | None:
    """The configuration of a stream; `None` if the servers don't have it."""
    try:
        return dict((await _ask(client, f"STREAM.INFO.{name}"))["config"])
    except _NotFound:
        return None


async def _last(client: SafeClient, stream: str, subject: str) -> tuple[int, bytes]:
    """The last message with this subject, and its sequence; empty if the stream has none."""
    try:
        found = await _ask(client, f"STREAM.MSG.GET.{stream}", {"last_by_subj": subject})
    except _NoMessage:
        return 0, b""
    message = found["message"]
    return int(message["seq"]), base64.b64decode(message.get("data", ""))


async def _newest_snapshot(client: SafeClient, log: str) -> _Snapshot:
    """Raises `BackupFailed` if there is none."""
    keys, _, steps = streams(log)
    at, key = await _last(client, keys, f"$KV.{steps}.{SNAPSHOT_KEY}")
    if not key:
        raise BackupFailed(f"{keys} has no key {SNAPSHOT_KEY}: {NO_USABLE_BACKUP}")
    try:
        newest = json.loads(key)["newest"]
        return _Snapshot(at, int(newest["sequence"]), str(newest["object"]))
    except (ValueError, KeyError, TypeError) as error:
        reason = (
            f"{keys}: the key {SNAPSHOT_KEY} is {key[:100]!r}, not a snapshot: {NO_USABLE_BACKUP}"
        )
        raise BackupFailed(reason) from error


async def _back_up(client: SafeClient, log: str, folder: Path) -> int:
    for attempt in range(1, ATTEMPTS + 1):
        try:
            contents = await _fetch_all(client, log, folder)
            break
        except _Replaced:
            if attempt == ATTEMPTS:
                raise
    text = json.dumps({"version": VERSION, "log": log, "streams": contents}, indent=2)
    with (folder / "backup.json").open("xb") as out:
        out.write(text.encode())
        out.flush()
        os.fsync(out.fileno())
    return int(contents[streams(log)[-1]]["state"]["messages"])


async def _fetch_all(client: SafeClient, log: str, folder: Path) -> dict[str, dict[str, Any]]:
    """Writes all streams to files. Raises `_Replaced` if they don't have what the keys name."""
    keys, objects, steps = streams(log)
    contents = {keys: await _fetch(client, keys, folder / keys)}
    newest = await _newest_snapshot(client, log)
    if newest.key > int(contents[keys]["state"]["last_seq"]):
        raise _Replaced(REPLACED)  # The file names another one.
    for name in (objects, steps):
        contents[name] = await _fetch(client, name, folder / name)
    missing = await _missing(client, log, newest)
    if missing is not None:
        if await _newest_snapshot(client, log) != newest:
            raise _Replaced(REPLACED)
        raise BackupFailed(f"{missing}: {NO_USABLE_BACKUP}")
    return contents


async def _missing(client: SafeClient, log: str, snapshot: _Snapshot) -> str | None:
    """What the servers lack of a snapshot and the steps behind it; `None` if they have all."""
    _, objects, steps = streams(log)
    encoded = base64.urlsafe_b64encode(snapshot.object.encode()).decode()
    _, meta = await _last(client, objects, f"$O.{steps}.M.{encoded}")
    if not _is_there(meta):
        return f"{objects} has no object {snapshot.object}, the newest snapshot"
    next_step = snapshot.sequence + 1
    first = int((await _ask(client, f"STREAM.INFO.{steps}"))["state"]["first_seq"])
    if first > next_step:
        return f"messages {next_step} to {first - 1} behind the newest snapshot are missing"
    return None


async def _fetch(client: SafeClient, name: str, file: Path) -> dict[str, Any]:
    """Writes a stream to a file. Returns what a server needs to restore it.

    Raises `_Replaced` if messages were removed meanwhile: the server sends each part of a stream as
    it is when its turn comes, so the file may lack them.
    """
    inbox = client.new_inbox()
    parts = await client.subscribe(inbox)
    request = {"deliver_subject": inbox, "no_consumers": True, "chunk_size": CHUNK_BYTES}
    answer = await _ask(client, f"STREAM.SNAPSHOT.{name}", request)
    digest = hashlib.sha256()
    with file.open("wb") as out:
        while True:
            part = await parts.next_msg(timeout=ANSWER_TIMEOUT_S)
            if not part.data:
                status = (part.headers or {}).get("Status", "204")
                if status != "204":
                    raise BackupFailed(f"{name}: the server has ended the backup: {part.headers}")
                break
            out.write(part.data)
            digest.update(part.data)
            if part.reply:
                await client.publish(part.reply, b"")
        out.flush()
        os.fsync(out.fileno())
    await parts.unsubscribe()
    now = (await _ask(client, f"STREAM.INFO.{name}"))["state"]
    if _removed(now) != _removed(answer["state"]):
        raise _Replaced(REPLACED)
    return {
        "config": answer["config"],
        "state": answer["state"],
        "sha256": digest.hexdigest(),
    }


def _is_there(meta: bytes) -> bool:
    """Whether an object has not been deleted: its description says so then."""
    try:
        return not json.loads(meta).get("deleted")
    except (ValueError, AttributeError):
        return False


def _removed(state: dict[str, Any]) -> int:
    """How many messages a stream has had and does not have any more."""
    return int(state["last_seq"]) - int(state["messages"])


def _checked(folder: Path, log: str) -> dict[str, Any]:
    """The streams of a backup, whose files are complete."""
    try:
        found = json.loads((folder / "backup.json").read_bytes())
        if found["version"] != VERSION:
            raise BackupFailed(f"{folder}: version {found['version']}, allowed: {VERSION}")
        if found["log"] != log:
            raise BackupFailed(f"{folder}: a backup of the log {found['log']}, not of {log}")
        contents: dict[str, Any] = found["streams"]
        for name in streams(log):
            with (folder / name).open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            if digest != contents[name]["sha256"]:
                raise BackupFailed(f"{folder / name}: damaged, its SHA-256 is another one")
    except OSError as error:
        raise BackupFailed(f"{error.filename}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise BackupFailed(f"{folder}: damaged, or not a backup of a log") from error
    return contents


async def _existing(client: SafeClient, log: str) -> list[str]:
    """The streams of a log, and of its leases, that the servers have."""
    every = (*streams(log), *leases(log))
    return [name for name in every if await _config(client, name) is not None]


async def _refuse_existing(client: SafeClient, log: str) -> None:
    """Raises `BackupFailed` if the servers have the log, or a part of it."""
    there = await _existing(client, log)
    if not there:
        return
    keys, _, steps = streams(log)
    key = b""
    if keys in there:
        _, key = await _last(client, keys, f"$KV.{steps}.{SNAPSHOT_KEY}")
    if key:
        reason = f"the servers already have the log: {', '.join(there)}"
    else:
        reason = (
            f"the servers already have {', '.join(there)}, but no key of a snapshot, as after a "
            "restore that was cut short: if no node runs, delete these streams, for example with "
            "nats stream rm, and restore again"
        )
    raise BackupFailed(reason)


async def _restore(
    client: SafeClient,
    log: str,
    replicas: int,
    folder: Path,
    contents: dict[str, Any],
    confirmed: dict[str, bool],
) -> int:
    """Notes in `confirmed` which streams the servers restore, and if they have confirmed it."""
    for name in reversed(streams(log)):
        config = contents[name]["config"] | {"num_replicas": replicas}
        request = {"config": config, "state": contents[name]["state"]}
        answer = await _ask(client, f"STREAM.RESTORE.{name}", request)
        confirmed[name] = False
        await _send(client, name, answer["deliver_subject"], folder / name, contents[name])
        confirmed[name] = True
    return int(contents[streams(log)[-1]]["state"]["messages"])


async def _clean_up(client: SafeClient, log: str, confirmed: dict[str, bool]) -> str | None:
    """Deletes what was restored. Returns why not, if a node may use it."""
    # A node may have made a stream while it was restored, or gone on with those restored before.
    others = [name for name in await _existing(client, log) if not confirmed.get(name)]
    if others:
        return (
            f"A node seems to run, since the servers now have {', '.join(others)}; nothing was "
            "deleted. Stop all nodes. If one has gone on with the log, start them again; otherwise "
            "delete the streams of the log, for example with nats stream rm, and restore again"
        )
    for name in reversed(confirmed):
        # A cluster keeps the name of a stream whose restore was cut short, and makes it later.
        with contextlib.suppress(_NotFound):
            await _ask(client, f"STREAM.DELETE.{name}")
    return None


async def _send(
    client: SafeClient, name: str, subject: str, file: Path, content: dict[str, Any]
) -> None:
    with file.open("rb") as data:
        # An account may have a smaller limit than the server.
        while part := data.read(min(CHUNK_BYTES, client.max_payload)):
            reply = await _request(client, subject, part)
            if reply.data:
                raise BackupFailed(f"{name}: {_error(reply.data)}")
    reply = await _request(client, subject, b"")
    found = json.loads(reply.data)
    if "error" in found:
        raise BackupFailed(f"{name}: {_error(reply.data)}")
    messages = found["state"]["messages"]
    if messages < content["state"]["messages"]:
        raise BackupFailed(f"{name}: the server has restored {messages} messages only")


def _error(data: bytes) -> str:
    try:
        return str(json.loads(data)["error"]["description"])
    except (ValueError, KeyError, TypeError):
        return data[:200].decode(errors="replace")


async def _set_replicas(client: SafeClient, log: str, replicas: int) -> dict[str, tuple[int, int]]:
    found = {}
    for name in (*streams(log), *leases(log)):
        config = await _config(client, name)
        if config is None:
            if name in leases(log):
                continue  # No node has needed it since the log was restored.
            raise BackupFailed(f"the servers don't have {name}")
        before = config["num_replicas"]
        if before != replicas:
            await _ask(client, f"STREAM.UPDATE.{name}", config | {"num_replicas": replicas})
        found[name] = before, replicas
    return found
