"""`holdfast audit`: verifies audit logs."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.cli import SuggestingGroup
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import json_option, option
from holdfast.config.values.scalars import parse_sha256
from holdfast.events.audit import verify as verified
from holdfast.runtime.text import file_error_text

if TYPE_CHECKING:
    from holdfast.events.audit import Findings


@click.group(cls=SuggestingGroup, epilog="Example: holdfast audit verify audit.log*")
def audit() -> None:
    """Verify audit logs."""


def _digest(text: str) -> str:
    try:
        return parse_sha256(text)
    except ValueError:
        raise click.BadParameter("allowed: 64 hexadecimal digits") from None


@audit.command(epilog="Example: holdfast audit verify audit.log*")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@option(
    "--anchor anchors",
    "DIGEST",
    "Digest of a line that must be in the files, as printed by an earlier verification.",
    _digest,
    multiple=True,
)
@json_option
def verify(files: tuple[Path, ...], anchors: tuple[str, ...], as_json: bool) -> None:
    """Verify that lines in the FILES of an audit log are unchanged, complete and in order.

    The files can be given in any order. Exit codes: 0 intact, 1 a line was changed, deleted,
    inserted or moved, or an anchor is missing, 2 a file can't be read, is compressed or is not an
    audit log, or all are empty, 3 intact, but the log itself reports missing lines, or has lines
    without a place in the chain.
    """
    try:
        findings = verified(files, anchors)
    except OSError as error:
        fail(file_error_text(error), ExitCode.WRONG, reason="file")
    click.echo(_as_json(findings) if as_json else _as_text(findings))
    if _wrong(findings):
        sys.exit(ExitCode.FAILED)
    if findings.gaps:
        sys.exit(ExitCode.ATTENTION)


def _wrong(findings: Findings) -> list[str]:
    """Why the files are not intact."""
    errors = [] if findings.error is None else [findings.error]
    return errors + [f"no line has the digest {each}" for each in findings.missing_anchors]


def _as_json(findings: Findings) -> str:
    wrong = _wrong(findings)
    return json.dumps(
        {
            "ok": not wrong,
            "target": " ".join(map(str, findings.files)),
            **({"reason": "not_intact", "detail": "; ".join(wrong)} if wrong else {}),
            "files": [str(file) for file in findings.files],
            "lines": findings.lines,
            "missing_anchors": sorted(findings.missing_anchors),
            "lost": findings.lost,
            "breaks": dict(findings.breaks),
            "unchained": findings.unchained,
            "starts_without_stop": findings.unended,
            "first_prev": findings.first,
            "last_digest": findings.last,
        },
        indent=2,
    )


def _as_text(findings: Findings) -> str:
    lines = [f"not intact: {each}" for each in _wrong(findings)]
    if not lines:
        lines.append("intact")
    files = _counted(len(findings.files), "file")
    lines.append(f"verified: {_counted(findings.lines, 'line')} in {files}")
    if findings.lost:
        lines.append(f"gap: {_counted(findings.lost, 'line')} could not be written")
    lines += [
        f"gap: {reason}, {_counted(count, 'time')}" for reason, count in findings.breaks.items()
    ]
    if findings.unchained:
        lines.append(f"gap: {_counted(findings.unchained, 'line')} without a place in the chain")
    if findings.unended:
        lines.append(f"starts without a stop before: {findings.unended}")
    if findings.first is not None:
        lines.append(f"begins after the line with the digest {findings.first}")
    if findings.last is not None:
        lines.append(f"digest of the last line: {findings.last}")
    return "\n".join(lines)


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"
