"""What a process that serves asks of its Python interpreter."""

from __future__ import annotations

import subprocess
import sys

import pytest

IMPORTS = """
import sys
from holdfast.runtime.interpreter import complete_hashlib, spare_memory
with spare_memory():
    import holdfast.config.models.root
heavy = {"_hashlib", "email", "zipfile", "importlib.metadata"} & set(sys.modules)
assert not heavy, heavy
"""


@pytest.mark.parametrize(
    "then",
    [
        "import hashlib; assert hashlib.sha256(b'a').hexdigest().startswith('ca978112')",
        "import hmac; assert hmac.new(b'a', b'b', 'sha256').hexdigest().startswith('08de3299')",
        "import hashlib; complete_hashlib(); hashlib.scrypt(b'a', salt=b'b', n=2, r=1, p=1)",
        "from importlib.metadata import entry_points; assert entry_points(group='console_scripts')",
        "import ssl, asyncio; ssl.create_default_context()",
    ],
)
def test_what_was_spared_is_there_when_it_is_needed(then: str) -> None:
    subprocess.run([sys.executable, "-c", IMPORTS + then], check=True)


def test_while_memory_is_spared_only_pydantic_has_no_plugins() -> None:
    program = """
import importlib, sys
from holdfast.runtime.interpreter import spare_memory
with spare_memory():
    from importlib.metadata import entry_points, version
    assert entry_points(group="pydantic") == ()
    assert entry_points(group="console_scripts") and version("pydantic")
assert importlib.metadata is sys.modules["importlib.metadata"]
import importlib.metadata as found
assert found.entry_points(group="pydantic") is not None and found.__file__
"""
    subprocess.run([sys.executable, "-c", program], check=True)
