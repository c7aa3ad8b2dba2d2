"""Requirements of the application protocol that no test of a part shows."""

from __future__ import annotations

import holdfast
from support.fake_device import Stream


def test_a_client_fills_the_last_byte_of_coils_with_zeros() -> None:
    with Stream("tcp") as device, holdfast.SyncClient(device.url) as client:
        for count in range(1, 17):
            client.write_coils(0, [True] * count)

    data = [asked.pdu[6:] for asked in device.requests]
    assert data == [
        ((1 << count) - 1).to_bytes((count + 7) // 8, "little") for count in range(1, 17)
    ]
