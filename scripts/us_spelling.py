#!/usr/bin/env python3
"""Writes identifiers, comments and documents in US spelling, by the table tests/it/documents/us_spelling.txt.

    scripts/us_spelling.py            lists what is spelled otherwise, and exits with status 1 if there is anything, with 2 without git
    scripts/us_spelling.py --write    changes it, in texts and in the names of files that git has

Names that others read stay as they are: KEPT. So do outputs of earlier versions, migrations, the changelog and what other projects wrote.
Standard library only.
"""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "tests" / "it" / "documents" / "us_spelling.txt"

# A field of metrics, a key of checkpoints, and cases of the oracle.
KEPT = ["psnr_before_quantisation", "context.centre", "odd_size_offcentre", "quat_unnormalised"]

# Beginnings of paths.
LEFT = [
    "CHANGELOG.md",
    "Cargo.lock",
    "LICENSE",
    "examples/embed/Cargo.lock",
    "fuzz/Cargo.lock",
    "migrations/",
    "scripts/us_spelling.py",
    "tests/golden/",
    "tests/hardware/",
    "tests/it/documents/retired_words.txt",
    "tests/it/documents/us_spelling.txt",
    "tests/oracles/",
    "tests/schemas/",
]


def table():
    lines = TABLE.read_text().splitlines()
    return [line.split(" -> ") for line in lines if line and not line.startswith("#")]


def cased(old, new):
    """`new` in the case of what was found."""
    if old.isupper():
        return new.upper()
    return new[0].upper() + new[1:] if old[0].isupper() else new


def respelled(text, rules):
    kept = "|".join(re.escape(name) for name in KEPT)
    for pattern, new in rules:
        # What is kept is matched first, as a whole, and put back.
        expression = re.compile(f"({kept})|({pattern})", re.IGNORECASE)
        text = expression.sub(lambda match: match.group(1) or cased(match.group(2), new), text)
    return text


def main():
    rules = table()
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        print(f"us_spelling: git lists no files: {listed.stderr.strip()}", file=sys.stderr)
        sys.exit(2)
    writes = sys.argv[1:] == ["--write"]
    found = 0
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if name.startswith(tuple(LEFT)) or path.is_symlink() or not path.is_file():
            continue
        try:
            text = path.read_text()
        except UnicodeDecodeError:
            continue
        changed, moved = respelled(text, rules), respelled(name, rules)
        if changed == text and moved == name:
            continue
        found += 1
        if writes:
            path.write_text(changed)
            if moved != name:
                subprocess.run(["git", "mv", name, moved], cwd=ROOT, check=True)
            continue
        for number, (line, new) in enumerate(zip(text.splitlines(), changed.splitlines()), 1):
            if line != new:
                print(f"{name}:{number}: {line.strip()}")
        if moved != name:
            print(f"{name}: its name")
    sys.exit(1 if found and not writes else 0)


main()
