#!/usr/bin/env python3
"""Rewrites the tables of docs/HARDWARE.md from the files that scripts/gpu_day.sh writes.

    scripts/hardware.py [--document FILE] JSON...

Files of the same adapter, driver and revision become one section; of a command that several of them ran, the last counts. The
tables replace the text between the document's lines `<!-- hardware: begin -->` and `<!-- hardware: end -->`. Standard library only.
"""

import argparse
import json
import sys
from pathlib import Path

DOCUMENT = Path(__file__).resolve().parent.parent / "docs/HARDWARE.md"
MARKERS = ("<!-- hardware: begin -->", "<!-- hardware: end -->")
NO_VALUE = "–"
LEFT_OUT = "left out"
# Kernels that are listed by name; the others of a table are summed in its last row.
MAX_KERNELS = 16
# Kernels of a stage of the profile that are named.
MAX_STAGE_KERNELS = 3


class Machine:
    """The runs of one adapter, driver and revision, by name."""

    def __init__(self, document):
        self.described = document["machine"]
        self.revision = document["revision"]
        self.started = document["started"]
        self.runs = {}

    def add(self, document):
        for run in document["runs"]:
            if run["status"] != LEFT_OUT or run["name"] not in self.runs:
                self.runs[run["name"]] = run

    def figures(self, kind):
        """Names and runs of a kind that have figures."""
        return [(name, run) for name, run in self.runs.items() if run["kind"] == kind and run.get("figures")]


def machines(documents):
    found = {}
    for document in documents:
        described = document["machine"]
        key = (described.get("adapter"), described.get("driver"), document["revision"])
        found.setdefault(key, Machine(document)).add(document)
    return list(found.values())


def decimals(value, places):
    return NO_VALUE if value is None else f"{value:.{places}f}"


def table(head, rows):
    """A table whose columns are of figures, except the first and those whose head ends with a space."""
    rules = ["---" if at == 0 or name.endswith(" ") else "--:" for at, name in enumerate(head)]
    lines = [[name.strip() for name in head], rules, *rows]
    return "\n".join(f'| {" | ".join(line)} |' for line in lines)


def size_name(size):
    return f'{size["gaussians"]}, {size["width"]}x{size["height"]}'


def checks(machine):
    """What was tested, and with which result."""
    for _, run in machine.figures("accuracy"):
        figures = run["figures"]
        yield f'- Errors within their bounds (`tcgs bench accuracy`): {figures["held"]} of {figures["errors"]}.'
        if figures["largest_share_of_bound"] is not None:
            share = decimals(100 * figures["largest_share_of_bound"], 0)
            yield f'- Error nearest to its bound: {figures["largest_share"]}, at {share} %.'
        for case in figures["exceeded"]:
            yield f"- Bound exceeded: {case}."
    for _, run in machine.figures("compare"):
        result = "the same bytes" if run["figures"]["same_bytes"] else "other bytes"
        yield f"- The same seed twice: {result}."
    for _, run in machine.figures("tests"):
        figures = run["figures"]
        if "passed" in figures:
            yield f'- Tests of the kernels: {figures["passed"]} passed, {figures["failed"]} failed.'
        for name in figures["failed_tests"]:
            yield f"- Test failed: `{name}`."


def not_finished(machine):
    """Commands without a result."""
    for name, run in machine.runs.items():
        if run["status"] != "ok":
            reason = f', {run["reason"]}' if "reason" in run else ""
            yield f'- Not finished: {name} ({run["status"]}{reason}).'


def flags(run):
    """Flags of a training run that are not the same in all of them."""
    words = run["command"].split()
    words = words[words.index("train") + 4 :]
    return " ".join(word for word in words if word != "--json")


def trainings(machine):
    rows = []
    for name, run in machine.figures("train"):
        figures, seconds = run["figures"], run["figures"]["seconds"]
        if "profile" in figures:
            continue
        is_alone = run["mode"] == "alone"
        test = figures["test"] or {"psnr": None, "ssim": None, "views": 0}
        row = [name, f"`{flags(run)}`", str(figures["steps"])]
        row += [decimals(seconds["train"] if is_alone else None, 1), decimals(run["seconds"] if is_alone else None, 1)]
        row += [decimals(test["psnr"], 2), decimals(figures["psnr_before_quantization"], 2), decimals(test["ssim"], 4), str(test["views"])]
        counts = [figures["bytes"]["total"], figures.get("anchors"), figures.get("gaussians")]
        rows.append(row + [str(count) if count else NO_VALUE for count in counts])
    if rows:
        yield "#### Training runs"
        yield (
            "PSNR and SSIM are those of held-out views of the decoded file. Seconds of the command include reading, encoding and "
            "evaluation. Runs without seconds ran side by side."
        )
        head = ["run", "flags ", "steps", "training s", "command s", "PSNR dB", "before quantization", "SSIM", "views", "bytes", "anchors", "Gaussians"]
        yield table(head, rows)


def steps(machine):
    """Stages and whole steps of the kernel benchmark, by size."""
    for _, run in machine.figures("kernels"):
        figures = run["figures"]
        sizes = figures["sizes"]
        yield "#### Steps of the kernel benchmark, ms"
        if figures["ceilings"]:
            copy, reads, arithmetic = (figures["ceilings"][key] for key in ("copy_gb_s", "random_reads_gb_s", "arithmetic_gflop_s"))
            yield table(["peak rate", "measured"], [
                ["copy", f"{decimals(copy, 0)} GB/s"],
                ["random reads", f"{decimals(reads, 0)} GB/s"],
                ["arithmetic", f"{decimals(arithmetic / 1000, 1)} TFLOP/s"],
            ])
        yield (
            "Columns are numbers of Gaussians and sizes of the picture; percentages are shares of the peak rate that limits the stage. "
            "A step is in wall time, a stage in device time."
        )
        rows = []
        for at, stage in enumerate(sizes[0]["stages"]):
            cells = [size["stages"][at] if at < len(size["stages"]) else None for size in sizes]
            texts = [f'{decimals(cell["ms"], 2)} ({decimals(cell["share_percent"], 0)} %)' if cell else NO_VALUE for cell in cells]
            rows.append([stage["stage"], *texts])
        plain = {"plain step": "wall_ms", "plain step, device": "device_ms", "plain step, recording and submitting": "host_ms"}
        for name, key in plain.items():
            rows.append([name, *(decimals(size.get("plain_step", {}).get(key), 2) for size in sizes)])
        yield table(["stage", *map(size_name, sizes)], rows)
        for step in ("step", "plain step"):
            yield from kernels_of(step, sizes)


def kernels_of(step, sizes):
    """Kernels of a kind of step, the longest at the last size first."""
    of = [size["kernels"].get(step, {}) for size in sizes]
    names = sorted({name for kernels in of for name in kernels}, key=lambda name: (-(of[-1].get(name) or 0), name))
    if not names:
        return
    rows = [[f"`{name}`", *(decimals(kernels.get(name), 3) for kernels in of)] for name in names[:MAX_KERNELS]]
    if others := names[MAX_KERNELS:]:
        rows.append([f"{len(others)} others", *(decimals(sum(kernels.get(name) or 0 for name in others), 3) for kernels in of)])
    yield f"Kernels of the {step}:"
    yield table(["kernel", *map(size_name, sizes)], rows)


def contexts(machine):
    rows = []
    for _, run in machine.figures("context"):
        for size in run["figures"]["sizes"]:
            for kind in size["kinds"]:
                longest = sorted(kind["kernels"].items(), key=lambda item: -(item[1] or 0))[:MAX_STAGE_KERNELS]
                rows.append([
                    f'{size["anchors"]} of {size["all_anchors"]}', kind["kind"], decimals(kind["forward_ms"], 2),
                    decimals(kind["forward_backward_ms"], 2), named(longest, 3),
                ])
    if rows:
        yield "#### Context model, ms"
        yield table(["anchors", "kind ", "forward", "with backward", "longest kernels "], rows)


def named(kernels, places):
    return ", ".join(f"`{name}` {decimals(ms, places)}" for name, ms in kernels) or NO_VALUE


def profile(machine):
    """Stages of a training step with their longest kernels, and the other recordings as a whole."""
    for name, run in machine.figures("train"):
        rows = run["figures"].get("profile")
        if not rows:
            continue
        yield f'#### A training step, ms ({name}: `{flags(run)}`)'
        stages = [row for row in rows if row["recording"] == "step" and row["kernel"] is None]
        cells = []
        for stage in sorted(stages, key=lambda row: -(row["device_ms"] or 0)):
            kernels = [row for row in rows if row["recording"] == "step" and row["stage"] == stage["stage"] and row["kernel"]]
            longest = sorted(((row["kernel"], row["device_ms"]) for row in kernels), key=lambda item: -(item[1] or 0))
            cells.append([
                "other" if stage["stage"] == "-" else stage["stage"], decimals(stage["host_ms"], 2),
                decimals(stage["device_ms"], 2), named(longest[:MAX_STAGE_KERNELS], 2),
            ])
        total = sum(row["device_ms"] or 0 for row in stages)
        cells.append(["sum", decimals(sum(row["host_ms"] or 0 for row in stages), 2), decimals(total, 2), NO_VALUE])
        yield table(["stage", "host", "device", "longest kernels "], cells)
        yield from other_recordings(rows)


def other_recordings(rows):
    sums = {}
    for row in rows:
        if row["recording"] != "step" and row["kernel"] is None:
            host, device, count = sums.get(row["recording"], (0.0, 0.0, 0.0))
            sums[row["recording"]] = (host + (row["host_ms"] or 0), device + (row["device_ms"] or 0), max(count, row["count"]))
    if sums:
        yield "Beside the steps, in all:"
        ordered = sorted(sums.items(), key=lambda item: -item[1][0])
        yield table(
            ["work", "times", "host", "device"],
            [[name, decimals(count, 0), decimals(host, 1), decimals(device, 1)] for name, (host, device, count) in ordered],
        )


def views(machine):
    for _, run in machine.figures("views"):
        yield "#### Views, frames per second"
        scene = next((Path(word).name for word in run["command"].split() if word.endswith(".tcgs")), "")
        yield f"The scene is `{scene}`."
        rows = [
            [f'{size["width"]}x{size["height"]}', *(decimals(size[key], 1) for key in ("device", "image", "jpeg"))]
            for size in run["figures"]["sizes"]
        ]
        yield table(["size", "on the device", "as image", "as JPEG"], rows)


def section(machine):
    described = machine.described
    yield f'### {described.get("adapter", "unknown adapter")}, {machine.started[:10]}'
    yield table(
        ["", "value "],
        [
            ["driver", f'{described.get("driver", "")} ({described.get("backend", "")})'],
            ["processor", f'{described["processor"]}, {described["cores"]} cores'],
            ["revision", f"`{machine.revision}`"],
        ],
    )
    yield "\n".join([*checks(machine), *not_finished(machine)])
    for tables in (trainings, steps, contexts, profile, views):
        yield from tables(machine)


def rewrite(document, tables):
    """The document with `tables` between its markers."""
    begin, end = MARKERS
    before, found_begin, rest = document.partition(f"{begin}\n")
    _, found_end, after = rest.partition(end)
    if not (found_begin and found_end):
        sys.exit(f"hardware: the line {end if found_begin else begin} is missing")
    return f"{before}{begin}\n\n{tables}\n\n{end}{after}"


def main():
    arguments = argparse.ArgumentParser(description="Rewrites the tables of docs/HARDWARE.md.")
    arguments.add_argument("--document", type=Path, default=DOCUMENT)
    arguments.add_argument("files", nargs="+", type=Path, metavar="JSON")
    arguments = arguments.parse_args()
    documents = [json.loads(path.read_text(encoding="utf-8")) for path in arguments.files]
    tables = "\n\n".join(text for machine in machines(documents) for text in section(machine) if text)
    document = arguments.document
    document.write_text(rewrite(document.read_text(encoding="utf-8"), tables), encoding="utf-8")


if __name__ == "__main__":
    main()
