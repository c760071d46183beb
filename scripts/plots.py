#!/usr/bin/env python3
"""Draws PSNR against file size and against training seconds from the tables of docs/RESULTS.md and docs/LONG_RUNS.md, and what
context models save from those of docs/PLANES.md.

    scripts/plots.py            writes docs/img/quality.svg, docs/img/long.svg and docs/img/planes.svg
    scripts/plots.py --check    exits with status 1 if a committed figure is not what its tables give

Standard library only. The figures are opaque and have colors for light and dark, so they are legible on any page.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).resolve().parent.parent / "docs"

MODELS = ["3dgs", "scaffold", "tcgs"]
# Formats that 3dgs is converted to, by this program or others, and what they are called in the figure.
CONVERTED = {"spz": ".spz", "spz_v4": ".spz", "sog": ".sog"}

# Geometry in pixels. All panels span as many dB, so that a step up is as large in each.
WIDTH, TOP, ACROSS, WIDEST, HEIGHT, GUTTER, LEFT, SECOND_ROW = 880, 88, 850, 300, 150, 32, 38, 292
SPAN_DB = 6.0
BYTES_TICKS = [(1e5, "0.1"), (1e6, "1"), (1e7, "10 MB")]


@dataclass(frozen=True)
class Figure:
    """Where a figure and its tables are, relative to docs/, and the least and greatest value of its axes."""

    image: str
    tables: str
    sets: str
    bytes_range: tuple
    seconds_range: tuple
    seconds_ticks: tuple


FIGURES = [
    Figure(
        image="img/quality.svg",
        tables="RESULTS.md",
        sets="five sets",
        bytes_range=(1e4, 4e7),
        seconds_range=(0.0, 160.0),
        seconds_ticks=((0, "0"), (50, "50"), (100, "100"), (150, "150 s")),
    ),
    Figure(
        image="img/long.svg",
        tables="LONG_RUNS.md",
        sets="chair and plush in runs of 2000 and 10 000 steps",
        bytes_range=(5e4, 8e7),
        seconds_range=(0.0, 9000.0),
        seconds_ticks=((0, "0"), (3000, "3000"), (6000, "6000"), (9000, "9000 s")),
    ),
]

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
    """The rows of the first table below a heading, as dictionaries by column; none without such a heading."""
    lines = document.partition(f"\n{heading}\n")[2].splitlines()
    rows = []
    for line in lines:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            break
    return [dict(zip(rows[0], row)) for row in rows[2:]] if rows else []


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

    def __init__(self, left, top, width, low_db, value_range, logarithmic):
        self.left, self.top, self.width, self.low_db = left, top, width, low_db
        self.scale = math.log10 if logarithmic else float
        self.low, self.high = (self.scale(value) for value in value_range)

    def place(self, value, psnr):
        x = self.left + self.width * (self.scale(value) - self.low) / (self.high - self.low)
        return x, self.top + HEIGHT * (1 - (psnr - self.low_db) / SPAN_DB)

    def frame(self, ticks, name="", note=""):
        out = [f'<rect class="rule" x="{self.left}" y="{self.top}" width="{self.width}" height="{HEIGHT}"/>']
        for db in range(math.ceil(self.low_db), math.floor(self.low_db + SPAN_DB) + 1, 2):
            _, y = self.place(10 ** self.low if self.scale is math.log10 else self.low, db)
            out.append(f'<path class="rule" d="M{self.left} {y:.1f}h{self.width}"/>')
            out.append(f'<text x="{self.left - 5}" y="{y + 4:.1f}" text-anchor="end">{db}</text>')
        for value, label in ticks:
            x, _ = self.place(value, self.low_db)
            bottom = self.top + HEIGHT
            out.append(f'<path class="rule" d="M{x:.1f} {bottom}v4"/>')
            out.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{label}</text>')
        if name:
            out.append(f'<text class="name" x="{self.left}" y="{self.top - 6}">{name} <tspan class="note">{note}</tspan></text>')
        return out


def estimate(cell):
    """Mean and half-width of the interval, zero without one, of a cell such as `27.51 ± 0.12`."""
    mean, _, half = cell.partition(" ± ")
    return float(mean), float(half or 0)


def legend(formats):
    out, x, y = [], LEFT, 24
    for model in MODELS:
        out.append(mark(model, x + 4, y - 4))
        out.append(f'<text class="name" x="{x + 13}" y="{y}">{model}</text>')
        x += 88
    if formats:
        out.append(cross(x + 4, y - 4, ""))
        out.append(f'<text x="{x + 13}" y="{y}">3dgs as {" and ".join(formats)}</text>')
        x += 150
    out.append(f'<text x="{x}" y="{y}">filled: equal steps</text>')
    out.append(f'<text x="{x + 110}" y="{y}">hollow: more steps</text>')
    out.append(f'<text x="{x + 222}" y="{y}">line of tcgs: weights of the rate</text>')
    return out


class Point:
    """A row of the table of runs, or of that of exports."""

    def __init__(self, row, name):
        self.name, self.model = name, row["model"].partition("@")[0]
        self.steps = int(row["steps"])
        self.psnr, self.half = estimate(row["PSNR dB"])
        self.bytes, _ = estimate(row["bytes"])
        self.seconds = estimate(row["training s"])[0] if "training s" in row else None

    def title(self, of):
        spread = f" ± {self.half:.2f}" if self.half else ""
        return f"{of}, {self.name}, {self.steps} steps: {self.psnr:.2f}{spread} dB, {self.bytes:,.0f} bytes" + (
            f", {self.seconds:.0f} s" if self.seconds else ""
        )


def page(width, height, title, content):
    """A figure of these elements on its page."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img">\n'
        f"<title>{title}</title>\n"
        f"<style>{STYLE}</style>\n"
        f'<rect class="page" width="{width}" height="{height}"/>\n'
    )
    return head + "\n".join(content) + "\n</svg>\n"


def draw(figure, document):
    runs, exports = table(document, "### Runs"), table(document, "#### Exports")
    exports = [row for row in exports if row["model"] == "3dgs" and row["format"] in CONVERTED]
    out = legend(list(dict.fromkeys(CONVERTED[row["format"]] for row in exports)))
    names = list(dict.fromkeys(row["set"] for row in runs))
    width = min(WIDEST, ACROSS // max(len(names), 1) - GUTTER)
    for column, name in enumerate(names):
        points = [Point(row, row["model"]) for row in runs if row["set"] == name and row["model"].partition("@")[0] in MODELS]
        converted = [
            Point(row, f'3dgs as {row["format"]}')
            for row in exports
            if row["set"] == name
        ]
        # The preset's own weight comes first among those of a schedule.
        of_model = {model: [point for point in points if point.model == model] for model in MODELS}
        first = {model: of[0] for model, of in of_model.items() if of}
        steps = first["tcgs"].steps
        # By length of the run: the weights of the rate.
        curves = {}
        for point in of_model["tcgs"]:
            curves.setdefault(point.steps, []).append(point)
        longer = {
            model: [point for point in of if point.steps > steps and point.name == of[0].name][:1]
            for model, of in of_model.items()
        }
        converted = [point for point in converted if point.steps in curves]
        curved = [point for curve in curves.values() for point in curve]
        shown = [*first.values(), *curved, *converted, *(point for of in longer.values() for point in of)]
        psnrs = [point.psnr for point in shown]
        low_db = (min(psnrs) + max(psnrs) - SPAN_DB) / 2
        left = LEFT + column * (width + GUTTER)

        panel = Panel(left, TOP, width, low_db, figure.bytes_range, True)
        out += panel.frame(BYTES_TICKS, name, f"{steps} steps")
        out += [line("tcgs", [panel.place(point.bytes, point.psnr) for point in curve]) for curve in curves.values()]
        out += [cross(*panel.place(point.bytes, point.psnr), point.title(name)) for point in converted]
        seconds = Panel(left, SECOND_ROW, width, low_db, figure.seconds_range, False)
        rows = [(panel, lambda point: point.bytes), (seconds, lambda point: point.seconds)]
        out += seconds.frame(figure.seconds_ticks)
        for place, value in rows:
            for model, point in first.items():
                for more in longer[model]:
                    ends = [place.place(value(each), each.psnr) for each in (point, more)]
                    out.append(line(model, ends, True))
                    out.append(mark(model, *ends[1], True, more.title(name)))
                x, y = place.place(value(point), point.psnr)
                if point.half:
                    spread = point.half * HEIGHT / SPAN_DB
                    out.append(f'<path class="line m{model}" d="M{x:.1f} {y - spread:.1f}v{2 * spread:.1f}"/>')
                out.append(mark(model, x, y, False, point.title(name)))
    captions = [(TOP - 24, "PSNR in dB against bytes of the file"), (SECOND_ROW - 8, "PSNR in dB against seconds of training")]
    out += [f'<text x="{LEFT}" y="{y}">{caption}</text>' for y, caption in captions]
    title = f"PSNR of 3dgs, scaffold and tcgs on {figure.sets}, against file size and against training time"
    return page(WIDTH, SECOND_ROW + HEIGHT + 30, title, out)


# Columns of the table of whole files, and how their lines are drawn.
CONTEXTS = [
    ("tables", "3dgs", False),
    ("planes of 32", "tcgs", False),
    ("planes of 64", "tcgs", True),
    ("neighbors", "scaffold", True),
]
SIDE_BY_SIDE = "side by side"


def draw_planes(document):
    """Bytes over those with positions alone against anchors: lines through scenes side by side, hollow marks for single ones."""
    rows = table(document, "### Whole files")
    left, top, width, height, low, high = 46, 70, 560, 230, -2.0, 18.0
    first, last = math.log10(4e3), math.log10(1.3e5)

    def place(anchors, percent):
        x = left + width * (math.log10(anchors) - first) / (last - first)
        return x, top + height * (high - percent) / (high - low)

    out = [f'<text class="name" x="{left}" y="24">Bytes of a file over those with positions alone</text>']
    out.append(f'<text x="{left}" y="42">lines: scenes side by side; hollow: single scenes; planes of 128 are beyond the figure</text>')
    out.append(f'<rect class="rule" x="{left}" y="{top}" width="{width}" height="{height}"/>')
    for percent in range(0, int(high), 5):
        _, y = place(1e4, percent)
        out.append(f'<path class="rule" d="M{left} {y:.1f}h{width}"/>')
        out.append(f'<text x="{left - 5}" y="{y + 4:.1f}" text-anchor="end">{percent:+d} %</text>')
    for anchors in (5_000, 10_000, 20_000, 50_000, 100_000):
        x, _ = place(anchors, 0)
        out.append(f'<path class="rule" d="M{x:.1f} {top + height}v4"/>')
        label = f"{anchors // 1000} 000"
        out.append(f'<text x="{x:.1f}" y="{top + height + 16}" text-anchor="middle">{label}</text>')
    for column, model, dashed in CONTEXTS:
        points = []
        for row in rows:
            x, y = place(int(row["anchors"]), float(row[column].removesuffix(" %")))
            title = f'{row["scenes"]}, {row["anchors"]} anchors, {column}: {row[column]}'
            is_line = row["scenes"].endswith(SIDE_BY_SIDE)
            points += [(x, y)] if is_line else []
            out.append(mark(model, x, y, not is_line, title))
        out.append(line(model, points, dashed))
    for number, (column, model, dashed) in enumerate(CONTEXTS):
        x, y = left + width + 14, top + 14 + 20 * number
        out.append(line(model, [(x, y - 4), (x + 24, y - 4)], dashed))
        out.append(f'<text x="{x + 30}" y="{y}">{column}</text>')
    out.append(f'<text x="{left + width}" y="{top + height + 32}" text-anchor="end">anchors</text>')
    title = "Bytes of files with tables, planes and neighbors over those with positions, against the number of anchors"
    return page(760, top + height + 44, title, out)


def main():
    drawings = [(figure.image, figure.tables, lambda text, figure=figure: draw(figure, text)) for figure in FIGURES]
    drawings.append(("img/planes.svg", "PLANES.md", draw_planes))
    for path, tables, drawing in drawings:
        image = DOCS / path
        drawn = drawing((DOCS / tables).read_text(encoding="utf-8"))
        if "--check" not in sys.argv[1:]:
            image.write_text(drawn, encoding="utf-8")
        elif image.read_text(encoding="utf-8") != drawn:
            sys.exit(f"{image.name} is not what its tables give: run scripts/plots.py")


if __name__ == "__main__":
    main()
