#!/usr/bin/env python3
"""Renames an identifier in the Rust and WGSL that git has: whole words in code, in inline arguments of format strings and in comments.

    scripts/rename.py OLD NEW [PATH...]     in files below PATH, everywhere if there is none
    scripts/rename.py --prefix OLD NEW [PATH...]    every word that begins with OLD
    scripts/rename.py --code ...            comments stay

Texts of strings stay: they are messages and names that others read. A word that must not come back belongs into
tests/it/documents/retired_words.txt. Standard library only.
"""

import argparse
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

START = re.compile(r"//[^\n]*|/\*.*?\*/|\b(?:br|r)#*\"|b?\"|b?'(?:\\.|[^\\'\n])'", re.DOTALL)


def parts(text):
    """Pieces of a source with their kind: code, comment or string."""
    at = 0
    while match := START.search(text, at):
        yield "code", text[at : match.start()]
        token = match.group(0)
        if token.startswith("/"):
            kind, end = "comment", match.end()
        elif token.endswith("'"):
            kind, end = "string", match.end()
        elif "r" in token[:2]:
            close = '"' + token.lstrip("br")[:-1]
            kind, end = "string", text.index(close, match.end()) + len(close)
        else:
            kind, end = "string", match.end()
            while text[end] != '"':
                end += 2 if text[end] == "\\" else 1
            end += 1
        yield kind, text[match.start() : end]
        at = end
    yield "code", text[at:]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--prefix", action="store_true")
    parser.add_argument("--code", action="store_true")
    parser.add_argument("old")
    parser.add_argument("new")
    parser.add_argument("paths", nargs="*")
    arguments = parser.parse_args()
    end = "" if arguments.prefix else r"\b"
    word = re.compile(rf"\b{re.escape(arguments.old)}{end}")
    inline = re.compile(rf"\{{{re.escape(arguments.old)}" + (r"(?=\w*[}:])" if arguments.prefix else r"(?=[}:])"))
    listed = subprocess.run(
        ["git", "ls-files", "--", *arguments.paths], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    changed = 0
    for name in listed.splitlines():
        path = ROOT / name
        if path.suffix not in (".rs", ".wgsl") or path.is_symlink() or not path.is_file():
            continue
        text = path.read_text()
        if not word.search(text):
            continue
        pieces = []
        for kind, piece in parts(text):
            if kind == "code" or (kind == "comment" and not arguments.code):
                piece = word.sub(arguments.new, piece)
            elif kind == "string" and path.suffix == ".rs":
                piece = inline.sub("{" + arguments.new, piece)
            pieces.append(piece)
        result = "".join(pieces)
        if result != text:
            path.write_text(result)
            changed += 1
    print(f"{arguments.old} -> {arguments.new}: {changed} files")


main()
