#!/usr/bin/env python3
"""Draws docs/img/quality.svg from the tables of docs/RESULTS.md: PSNR against file size and against training seconds.

    scripts/plots.py            writes the figure
    scripts/plots.py --check    exits with status 1 if the committed figure is not what the tables give

Standard library only. The figure is opaque and has colours for light and dark, so it is legible on any page.
"""

import math
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLES = ROOT / "docs" / "RESULTS.md"
FIGURE = ROOT / "docs" / "img" / "quality.svg"

MODELS = ["3dgs", "scaffold", "tcgs"]
CONVERTED = ["3dgs as spz_v4", "3dgs as sog"]

# Geometry in pixels. All panels span as many dB, so that a step up is as large in each.
WIDTH, TOP, PANEL, HEIGHT, GUTTER, LEFT, SECOND_ROW = 880, 88, 138, 150, 32, 38, 292
SPAN_DB = 6.0
BYTES_RANGE, BYTES_TICKS = (8e4, 4e7), [(1e5, "0.1"), (1e6, "1"), (1e7, "10 MB")]
SECONDS_RANGE, SECONDS_TICKS = (0.0, 270.0), [(0, "0"), (100, "100"), (200, "200 s")]

STYLE = """
svg { --page: #ffffff; --ink: #1f2328; --soft: #59636e; --rule: #d1d9e0; --a: #bc4c00; --b: #0969da; --c: #1a7f37; }
@media (prefers-color-scheme: dark) {
  svg { --page: #0d1117; --ink: #f0f6fc; --soft: #9198a1; --rule: #3d444d; --a: #f0883e; --b: #58a6ff; --c: #3fb950; }
}
text { font: 11px system-ui, "Segoe UI", Helvetica, Arial, sans-serif; fill: var(--soft); }
.name { font-size: 12px; font-weight: 600; fill: var(--ink); }
.note { font-size: 11px; font-weight: normal; fill: var(--soft); }
.page { fill: var(--page); }
.rule { stroke: var(--rule); stroke-width: 1; fill: none; }
.m3dgs { --of: var(--a); } .mscaffold { --of: var(--b); } .mtcgs { --of: var(--c); }
.mark { fill: var(--of); stroke: var(--of); stroke-width: 1.6; }
.hollow { fill: var(--page); }
.line { stroke: var(--of); stroke-width: 1.6; fill: none; }
.faint { stroke-dasharray: 2 3; }
"""


def table(document, heading):
    """The rows of the first table below a heading, as dictionaries by column."""
    lines = document.split(f"### {heading}\n", 1)[1].splitlines()
    rows = []
    for line in lines:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            break
    return [dict(zip(rows[0], row)) for row in rows[2:]]


def mark(model, x, y, hollow=False, title=""):
    """A marker: square for 3dgs, triangle for scaffold, circle for tcgs."""
    kind = f'class="mark m{model}{" hollow" if hollow else ""}"'
    shapes = {
        "3dgs": f'<rect {kind} x="{x - 3.5:.1f}" y="{y - 3.5:.1f}" width="7" height="7">',
        "scaffold": f'<path {kind} d="M{x:.1f} {y - 4.5:.1f}l4.5 8h-9z">',
        "tcgs": f'<circle {kind} cx="{x:.1f}" cy="{y:.1f}" r="3.8">',
    }
    shape = shapes[model]
    return f"{shape}<title>{title}</title></{shape[1:].split(' ')[0]}>"


def cross(x, y, title):
    return f'<path class="line m3dgs" d="M{x - 3:.1f} {y - 3:.1f}l6 6m0 -6l-6 6"><title>{title}</title></path>'


def line(model, points, faint=False):
    path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    return f'<path class="line m{model}{" faint" if faint else ""}" d="{path}"/>'


class Panel:
    """A frame with its axes; `place` maps a value and a PSNR to pixels."""

    def __init__(self, left, top, low_db, value_range, logarithmic):
        self.left, self.top, self.low_db = left, top, low_db
        self.scale = math.log10 if logarithmic else float
        self.low, self.high = (self.scale(value) for value in value_range)

    def place(self, value, psnr):
        x = self.left + PANEL * (self.scale(value) - self.low) / (self.high - self.low)
        return x, self.top + HEIGHT * (1 - (psnr - self.low_db) / SPAN_DB)

    def frame(self, ticks, name="", note=""):
        out = [f'<rect class="rule" x="{self.left}" y="{self.top}" width="{PANEL}" height="{HEIGHT}"/>']
        for db in range(math.ceil(self.low_db), math.floor(self.low_db + SPAN_DB) + 1, 2):
            _, y = self.place(10 ** self.low if self.scale is math.log10 else self.low, db)
            out.append(f'<path class="rule" d="M{self.left} {y:.1f}h{PANEL}"/>')
            out.append(f'<text x="{self.left - 5}" y="{y + 4:.1f}" text-anchor="end">{db}</text>')
        for value, label in ticks:
            x, _ = self.place(value, self.low_db)
            bottom = self.top + HEIGHT
            out.append(f'<path class="rule" d="M{x:.1f} {bottom}v4"/>')
            out.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{label}</text>')
        if name:
            out.append(f'<text class="name" x="{self.left}" y="{self.top - 6}">{name} <tspan class="note">{note}</tspan></text>')
        return out


def legend():
    out, x, y = [], LEFT, 24
    for model in MODELS:
        out.append(mark(model, x + 4, y - 4))
        out.append(f'<text class="name" x="{x + 13}" y="{y}">{model}</text>')
        x += 88
    out.append(cross(x + 4, y - 4, ""))
    out.append(f'<text x="{x + 13}" y="{y}">3dgs as .spz and .sog</text>')
    x += 150
    out.append(f'<text x="{x}" y="{y}">filled: equal steps</text>')
    out.append(f'<text x="{x + 110}" y="{y}">hollow: equal seconds</text>')
    out.append(f'<text x="{x + 238}" y="{y}">line of tcgs: weights of the rate</text>')
    return out


def draw(document):
    steps, seconds = table(document, "Equal steps"), table(document, "Equal seconds")
    quality = table(document, "Quality against bytes")
    sets = list(dict.fromkeys(row["set"] for row in steps))
    out = legend()
    for column, name in enumerate(sets):
        def of(rows, key, wanted):
            return [row for row in rows if row["set"] == name and wanted(row[key])]

        whole = {row["model"]: row for row in of(steps, "model", lambda model: model in MODELS)}
        again = {row["model"]: row for row in of(seconds, "model", lambda model: model in MODELS)}
        curve = of(quality, "file", lambda file: file == "tcgs" or file.startswith("tcgs@"))
        converted = of(quality, "file", lambda file: file in CONVERTED)
        psnrs = [float(row["PSNR dB"]) for row in [*whole.values(), *again.values(), *curve, *converted]]
        low_db = (min(psnrs) + max(psnrs) - SPAN_DB) / 2
        left = LEFT + column * (PANEL + GUTTER)

        panel = Panel(left, TOP, low_db, BYTES_RANGE, True)
        out += panel.frame(BYTES_TICKS, name, f'{whole["tcgs"]["steps"]} steps')

        def by_bytes(row):
            return panel.place(float(row["bytes"]), float(row["PSNR dB"]))

        def title(row, label):
            return f'{name}, {label}: {row["PSNR dB"]} dB, {int(row["bytes"]):,} bytes'

        out.append(line("tcgs", [by_bytes(row) for row in curve]))
        out += [cross(*by_bytes(row), title(row, row["file"])) for row in converted]
        for model in MODELS:
            out.append(mark(model, *by_bytes(again[model]), True, title(again[model], f"{model}, equal seconds")))
            out.append(mark(model, *by_bytes(whole[model]), False, title(whole[model], model)))

        panel = Panel(left, SECOND_ROW, low_db, SECONDS_RANGE, False)
        out += panel.frame(SECONDS_TICKS)

        def by_seconds(row):
            return panel.place(float(row["training s"]), float(row["PSNR dB"]))

        for model in MODELS:
            out.append(line(model, [by_seconds(whole[model]), by_seconds(again[model])], True))
            for row, hollow in [(again[model], True), (whole[model], False)]:
                told = f'{name}, {model}: {row["PSNR dB"]} dB, {row["steps"]} steps in {row["training s"]} s'
                out.append(mark(model, *by_seconds(row), hollow, told))
    captions = [(TOP - 24, "PSNR in dB against bytes of the file"), (SECOND_ROW - 8, "PSNR in dB against seconds of training")]
    out += [f'<text x="{LEFT}" y="{y}">{caption}</text>' for y, caption in captions]
    height = SECOND_ROW + HEIGHT + 30
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" viewBox="0 0 {WIDTH} {height}" role="img">\n'
        "<title>PSNR of 3dgs, scaffold and tcgs on five sets, against file size and against training time</title>\n"
        f"<style>{STYLE}</style>\n"
        f'<rect class="page" width="{WIDTH}" height="{height}"/>\n'
    )
    return head + "\n".join(out) + "\n</svg>\n"


def main():
    figure = draw(TABLES.read_text(encoding="utf-8"))
    if "--check" in sys.argv[1:]:
        if FIGURE.read_text(encoding="utf-8") != figure:
            sys.exit(f"{FIGURE.name} is not what the tables give: run scripts/plots.py")
    else:
        FIGURE.write_text(figure, encoding="utf-8")


if __name__ == "__main__":
    main()
