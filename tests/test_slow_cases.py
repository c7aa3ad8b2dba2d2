"""The list of slow cases: each of them exists, and none of its lines is superfluous."""

from __future__ import annotations

import tomllib

from support import cases
from support.paths import ROOT

IDS = cases.slow_ids()


def test_each_line_stands_for_a_case(collected: list[str]) -> None:
    for line in IDS:
        is_one = (cases.is_listed(case, [line]) for case in collected)
        assert line.endswith(".rs") or any(is_one), line


def test_no_line_repeats_another() -> None:
    assert len(IDS) == len(set(IDS))
    for case in IDS:
        assert not cases.is_listed(case, set(IDS) - {case}), case


def test_rust_targets_that_make_test_leaves_out_are_listed() -> None:
    left_out = [
        f"{manifest.parent.relative_to(ROOT)}/tests/{target['name']}.rs"
        for manifest in ROOT.glob("crates/*/Cargo.toml")
        for target in tomllib.loads(manifest.read_text()).get("test", [])
        if not target.get("test", True)
    ]
    assert left_out == [case for case in IDS if case.endswith(".rs")]


def test_a_function_stands_for_all_its_cases() -> None:
    listed = ["tests/a.py", "tests/b.py::test_one", "tests/b.py::test_two[x]"]
    assert cases.is_listed("tests/a.py::test_any[1]", listed)
    assert cases.is_listed("tests/b.py::test_one[1]", listed)
    assert cases.is_listed("tests/b.py::test_two[x]", listed)
    assert not cases.is_listed("tests/b.py::test_two[y]", listed)
    assert not cases.is_listed("tests/c.py::test_one", listed)
