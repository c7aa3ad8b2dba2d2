"""Checks the dependencies: licences, where crates come from, and known vulnerabilities.

Vulnerabilities need the data of the Rust and Python projects, from the network. Where it can't be
had, that is said, and is no failure: docs/dependencies.md has the date of the last check.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
MANIFESTS = ("Cargo.toml", "crates/protocol/tests/no_std/Cargo.toml", "fuzz/Cargo.toml")

PERMISSIVE = (
    "Apache",
    "BSD",
    "ISC",
    "MIT",
    "PSF",
    "Python Software Foundation",
    "Unlicense",
)
"""Parts of the names of licences that packages at run time may have, as `pip-licenses` matches."""

FOR_TOOLS = ("MPL", "Mozilla Public License")
"""Further ones that tools and tests may have: they are not distributed."""


def main() -> None:
    """Prints what is wrong, and exits with 1 if anything is."""
    checks = [crates, crate_vulnerabilities, package_licences, package_vulnerabilities]
    if not all([check() for check in checks]):  # noqa: C419 - all of them, also after a failure
        sys.exit(1)


def crates() -> bool:
    """Licences and sources of the crates: deny.toml."""
    return all(deny(manifest, "check", "licenses", "bans", "sources") for manifest in MANIFESTS)


def crate_vulnerabilities() -> bool:
    """Known vulnerabilities of the crates."""
    if not deny(MANIFESTS[0], "fetch", "db", quiet=True):
        say("vulnerabilities of crates: not checked, the RustSec data can't be fetched")
        return True
    return all(deny(each, "check", "--disable-fetch", "advisories") for each in MANIFESTS)


def deny(manifest: str, *arguments: str, quiet: bool = False) -> bool:
    """Runs cargo-deny for a manifest."""
    command = ["cargo", "deny", "--locked", "--manifest-path", str(ROOT / manifest), *arguments]
    if arguments[0] == "check":
        command[-len(arguments) : -len(arguments)] = ["--config", str(ROOT / "deny.toml")]
    return not subprocess.run(command, capture_output=quiet).returncode


def package_licences() -> bool:
    """The licences of the installed Python packages."""
    installed = licences()
    run_time = pinned("appliance")
    good = True
    for name, licence in sorted(installed.items()):
        allowed = PERMISSIVE if name in run_time else PERMISSIVE + FOR_TOOLS
        if not any(part in licence for part in allowed):
            say(f"{name}: licence {licence!r}, allowed: {', '.join(allowed)}")
            good = False
    say(f"licences of {len(installed)} Python packages: {'ok' if good else 'see above'}")
    return good


def licences() -> dict[str, str]:
    """The licence of each installed package."""
    command = [sys.executable, "-m", "piplicenses", "--from=mixed", "--format=json"]
    command += ["--ignore-packages", "holdfast-modbus"]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return {normalized(each["Name"]): each["License"] for each in found}


def package_vulnerabilities() -> bool:
    """Known vulnerabilities of the pinned Python packages."""
    good = True
    for lock in ("appliance", "dev"):
        report = reported(lock)
        if report is None or not any("vulns" in each for each in report):
            say(f"vulnerabilities of requirements/{lock}.lock: not checked, no data can be fetched")
            continue
        for package in report:
            for found in package.get("vulns", []):
                say(f"{package['name']} {package['version']}: {found['id']} {found['description']}")
                good = False
    return good


def reported(lock: str) -> list[dict[str, Any]] | None:
    """What pip-audit says of each package of a lock file; None if it has no data."""
    file = ROOT / "requirements" / f"{lock}.lock"
    command = [sys.executable, "-m", "pip_audit", "--disable-pip", "--require-hashes"]
    command += ["--requirement", str(file), "--format", "json", "--progress-spinner", "off"]
    printed = subprocess.run(command, capture_output=True, text=True).stdout
    try:
        found: list[dict[str, Any]] = json.loads(printed)["dependencies"]
    except ValueError:
        return None
    return found


def pinned(lock: str) -> set[str]:
    """The packages of a lock file."""
    text = (ROOT / "requirements" / f"{lock}.lock").read_text()
    return {normalized(name) for name in re.findall(r"^([\w.-]+)==", text, re.MULTILINE)}


def normalized(name: str) -> str:
    """The name of a package as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def say(text: str) -> None:
    """Prints one line."""
    print(text, flush=True)


if __name__ == "__main__":
    main()
