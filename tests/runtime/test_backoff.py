"""Pauses between attempts."""

from __future__ import annotations

from holdfast.runtime.backoff import Backoff


def test_pauses_double_up_to_the_longest() -> None:
    backoff = Backoff(0.5, 3.0, jitter=False)
    assert [backoff.failed() for _ in range(5)] == [0.5, 1.0, 2.0, 3.0, 3.0]
    assert backoff.failures == 5


def test_no_pause_is_longer_than_the_longest_even_the_first() -> None:
    assert Backoff(1.0, 0.1, jitter=False).failed() == 0.1


def test_pauses_of_a_service_that_fails_for_years_stay_the_longest() -> None:
    backoff = Backoff(1.0, 60.0, jitter=False)
    backoff.failures = 10**9
    assert backoff.failed() == 60.0


def test_a_success_makes_the_next_failure_the_first_again() -> None:
    backoff = Backoff(1.0, 60.0, jitter=False)
    assert [backoff.failed() for _ in range(3)] == [1.0, 2.0, 4.0]
    backoff.succeeded()
    assert (backoff.failures, backoff.failed()) == (0, 1.0)


def test_only_what_worked_for_long_enough_makes_a_failure_the_first_again() -> None:
    backoff = Backoff(1.0, 60.0, jitter=False, proven_s=10.0)
    assert [backoff.failed(9.9) for _ in range(3)] == [1.0, 2.0, 4.0]
    assert [backoff.failed(10.0), backoff.failed(0.0)] == [1.0, 2.0]


def test_jitter_makes_pauses_up_to_a_quarter_shorter_and_never_longer() -> None:
    pauses = set()
    for _ in range(100):
        backoff = Backoff(1.0, 4.0, jitter=True)
        for longest in (1.0, 2.0, 4.0, 4.0):
            pause = backoff.failed()
            assert 0.75 * longest <= pause <= longest
            pauses.add(pause)
    assert len(pauses) > 300
