"""Tasks are ended, also those that lose a cancellation."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from holdfast.runtime import tasks


async def loses(cancellations: int) -> None:
    """Goes on after so many cancellations, as `asyncio.wait_for` of Python 3.11 may do."""
    for _ in range(cancellations):
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.Event().wait()
    await asyncio.Event().wait()


async def fails() -> None:
    raise ValueError


def test_tasks_that_lose_a_cancellation_are_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "CANCEL_INTERVAL_S", 0.01)

    async def work() -> list[bool]:
        works = (loses(0), loses(1), loses(3), fails())
        running = [asyncio.create_task(work) for work in works]
        await asyncio.sleep(0)
        await tasks.end(running)
        return [each.cancelled() for each in running]

    assert asyncio.run(work()) == [True, True, True, False]


def test_a_loop_can_notice_that_it_has_lost_a_cancellation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tasks, "CANCEL_INTERVAL_S", 3600.0)
    rounds = 0

    async def loop() -> None:
        nonlocal rounds
        while True:
            tasks.check()
            rounds += 1
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.Event().wait()

    async def work() -> bool:
        running = asyncio.create_task(loop())
        await asyncio.sleep(0)
        await tasks.end([running])
        return running.cancelled()

    assert asyncio.run(work())
    assert rounds == 1


def test_no_tasks_are_ended_at_once() -> None:
    asyncio.run(tasks.end([]))
