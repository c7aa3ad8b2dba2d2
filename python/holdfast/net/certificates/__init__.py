"""X.509 certificates: reading them, their expiry, and making them with an authority of one's own.

TLS itself is elsewhere: `holdfast_engine::tls` for Modbus, `holdfast.net.http` for HTTPS.
"""

from __future__ import annotations

from datetime import timedelta

EXPIRY_NOTICE = timedelta(days=30)
"""A certificate that expires within this time gives a warning."""
