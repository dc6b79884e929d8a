"""Fill a folder with links to the programs of a bare Debian machine: its essential packages, and those named.

    python3 .ci/bare_path.py FOLDER PACKAGE...

With PATH=FOLDER a command sees what a newcomer's machine has who installed these packages, and nothing else that
happens to be here: their dependencies and recommendations are followed, of alternatives the first that is installed.
"""

import re
import subprocess
import sys
from pathlib import Path

FIELDS = ("Package", "Essential", "Provides", "Pre-Depends", "Depends", "Recommends")


def installed() -> dict[str, dict[str, str]]:
    """Package -> its fields in dpkg's table, installed packages only."""
    form = "${db:Status-Status}\\t" + "\\t".join(f"${{{field}}}" for field in FIELDS) + "\\n"
    lines = subprocess.run(["dpkg-query", "-W", "-f", form], capture_output=True, text=True, check=True).stdout
    rows = [line.split("\t") for line in lines.splitlines()]
    return {row[1]: dict(zip(FIELDS, row[1:], strict=True)) for row in rows if row[0] == "installed"}


def alternatives(text: str) -> list[list[str]]:
    """The lists of alternatives in a field, names without versions and architectures."""
    groups = [[re.split(r"[ (:]", name.strip())[0] for name in group.split("|")] for group in text.split(",")]
    return [group for group in groups if group != [""]]


def providers(packages: dict[str, dict[str, str]]) -> dict[str, str]:
    """Name -> the installed package that serves for it: itself, or one that provides it (awk: mawk)."""
    virtual = {name: package for package in packages for (name,) in alternatives(packages[package]["Provides"])}
    return virtual | {name: name for name in packages}


def needs(fields: dict[str, str], serving: dict[str, str]) -> set[str]:
    """What a package needs or recommends, of each list of alternatives the first that is here."""
    lists = [group for field in FIELDS[3:] for group in alternatives(fields[field])]
    return {next((serving[name] for name in group if name in serving), "") for group in lists} - {""}


def main(folder: Path, *named: str) -> None:
    packages = installed()
    serving = providers(packages)
    missing = sorted(set(named) - set(packages))
    if missing:
        sys.exit(f"not installed: {' '.join(missing)}")
    wanted, ahead = set(), {*named, *(name for name, fields in packages.items() if fields["Essential"] == "yes")}
    while ahead:
        wanted |= ahead
        ahead = set().union(*(needs(packages[name], serving) for name in ahead)) - wanted
    folder.mkdir(parents=True)
    listed = subprocess.run(["dpkg", "-L", *sorted(wanted)], capture_output=True, text=True, check=True).stdout
    for path in map(Path, listed.split()):
        link = folder / path.name
        if path.parent.name in ("bin", "sbin") and path.is_file() and not link.is_symlink():
            link.symlink_to(path)
    # Debian's `cc`, `awk` and the like are links that its installation makes, and belong to no package.
    for alternative in Path("/etc/alternatives").iterdir():
        target = alternative.resolve()
        if (folder / target.name).is_symlink() and not (folder / alternative.name).is_symlink():
            (folder / alternative.name).symlink_to(target)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
