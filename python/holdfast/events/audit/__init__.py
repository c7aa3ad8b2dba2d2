"""The audit log: a chain of lines, one for each write, that shows later changes.

`Audit` writes it to a file, and copies it to syslog and the journal. `verify` checks files.
"""

from __future__ import annotations

from holdfast.events.audit.copies import Copies
from holdfast.events.audit.log import Audit, Unrecorded
from holdfast.events.audit.receivers import Journal, Syslog
from holdfast.events.audit.verification import Findings, verify

__all__ = ["Audit", "Copies", "Findings", "Journal", "Syslog", "Unrecorded", "verify"]
