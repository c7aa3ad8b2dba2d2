"""The upper limit of ingest over REST: parses the same JSON in a loop, and packs its values.

Nothing is received, checked or written. Prints the number of bodies and the rate as JSON.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

PARSERS: dict[str, Callable[[bytes], Any]] = {"msgspec": msgspec.json.decode, "json": json.loads}

body = Path(sys.argv[1]).read_bytes()
parse, seconds = PARSERS[sys.argv[2]], float(sys.argv[3])
done, start = 0, time.perf_counter()
while (now := time.perf_counter()) - start < seconds:
    document = parse(body)
    for command in document if isinstance(document, list) else [document]:
        values = command["values"]
        struct.pack(f">{len(values)}H", *values)
    done += 1
print(json.dumps({"answered": done, "rate": done / (now - start)}))
