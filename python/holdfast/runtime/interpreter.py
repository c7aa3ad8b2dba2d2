"""Settings of the Python interpreter for a process that serves."""

from __future__ import annotations

import contextlib
import gc
import importlib
import sys
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

SWITCH_INTERVAL_S = 0.05
"""How long a thread may hold the interpreter lock while others wait for it. Each switch wakes a
thread, which the scheduler may run before the threads that serve Modbus."""


COLLECT_AFTER = 10_000
"""New objects after which the interpreter looks for garbage: by default 700, which a few requests
have."""


METADATA = "importlib.metadata"
DIGESTS = (
    "_md5",
    "_sha1",
    *(("_sha2",) if sys.version_info >= (3, 12) else ("_sha256", "_sha512")),
    "_sha3",
    "_blake2",
)
"""The modules of Python's own digests. Some distributions have none."""


@contextlib.contextmanager
def spare_memory() -> Iterator[None]:
    """What is imported within takes less memory, as far as it was not imported before.

    hashlib takes Python's own digests, because OpenSSL takes 3.4 MB (see `complete_hashlib`), and
    pydantic does not look for plugins, which takes 2.5 MB. Where nothing needs TLS in Python, a
    process has neither.
    """
    stand_ins: dict[str, Any] = {METADATA: _NoPlugins(METADATA)}
    if all(map(find_spec, DIGESTS)):
        stand_ins["_hashlib"] = None  # It can't be imported.
    stand_ins = {name: module for name, module in stand_ins.items() if name not in sys.modules}
    sys.modules.update(stand_ins)
    try:
        yield
    finally:
        for name, module in stand_ins.items():
            if sys.modules.get(name, module) is module:
                sys.modules.pop(name, None)


class _NoPlugins(ModuleType):
    """In place of `importlib.metadata`: pydantic has no plugins, and all else is as it is."""

    def entry_points(self, **selected: Any) -> Any:
        """The entry points of all packages."""
        return () if selected == {"group": "pydantic"} else self._real.entry_points(**selected)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # The interpreter asks whether it is a package.
            raise AttributeError(name)
        return getattr(self._real, name)

    @property
    def _real(self) -> Any:
        if sys.modules.get(METADATA) is self:
            del sys.modules[METADATA]
        return importlib.import_module(METADATA)


def complete_hashlib() -> None:
    """Gives hashlib what only OpenSSL has: the code of other packages may use all of it."""
    hashlib = sys.modules.get("hashlib")
    if hashlib is not None and not hasattr(hashlib, "scrypt"):
        importlib.reload(hashlib)


def lengthen_switch_interval() -> None:
    """Lets a Python thread run longer before another: each switch delays native threads."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def freeze_garbage_collector() -> None:
    """Excludes all present objects from garbage collection, and makes collections less frequent.

    Modules and configuration stay to the end. A collection that looks at all of them takes 20 to
    30 ms, in which nothing in Python is answered.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(COLLECT_AFTER)
