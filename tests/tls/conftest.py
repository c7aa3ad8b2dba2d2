"""Certificates of every kind, made once for all tests of a module."""

from __future__ import annotations

import pytest

from support.certificate_cases import Mint, Shown


@pytest.fixture(scope="module")
def mint(tmp_path_factory: pytest.TempPathFactory) -> Mint:
    return Mint(tmp_path_factory.mktemp("mint"))


@pytest.fixture(scope="module")
def shown() -> dict[str, Shown]:
    """What was made so far: all faces see the same certificates."""
    return {}
