#!/usr/bin/env python3
"""Writes the figures of a run of scripts/gpu_day.sh as JSON and prints a summary.

    scripts/gpu_day.py RECORDS JSON

RECORDS is a folder with two files for each command: NAME.run has how it ran, a value a line, and NAME.txt its output. Exits with
status 1 if a command failed or its output has no figures. Standard library only, since it runs on the machine that is measured.
"""

import json
import math
import os
import re
import sys
from pathlib import Path

# Lines of a .run file, in this order; the command may itself have line breaks.
RECORD = ["began_ms", "part", "mode", "kind", "exit_status", "milliseconds", "reason", "command"]
# Exit statuses of `timeout`: stopped, and killed.
STOPPED = (124, 137)
# Metrics of a trained file that are kept as they are; of its views only the means are.
METRICS = ["bytes", "seconds", "steps", "steps_per_second", "anchors", "gaussians", "decode_sha256", "background", "adapter", "stages"]

NUMBER = r"([\d.]+|inf|NaN)"
SIZE = re.compile(r"(\d+) Gaussians, (\d+) x (\d+): (\d+) visible, ([\d.]+) tiles each; (\d+) anchors")
CEILINGS = re.compile(rf"ceilings: copy {NUMBER} GB/s, random reads {NUMBER} GB/s, arithmetic {NUMBER} GFLOP/s")
STAGE = re.compile(rf" *(\S.*?) +{NUMBER} +{NUMBER} +{NUMBER} +{NUMBER} +{NUMBER} +{NUMBER}%")
PLAIN_STEP = re.compile(rf" *plain step +{NUMBER} +{NUMBER} steps/s")
PLAIN_STEP_PARTS = re.compile(rf" *of it +{NUMBER} on the device, {NUMBER} recording and submitting")
KERNELS_OF = re.compile(r" *(step|plain step), its kernels")
KERNEL = re.compile(rf" {{8,}}(\w+) +{NUMBER}")
CONTEXT = re.compile(rf"context of (\d+) of (\d+) anchors: (\d+) parameters, {NUMBER} MB; tables of anchors in {NUMBER} ms")
CONTEXT_KIND = re.compile(rf" *(\S.*?) +{NUMBER} +{NUMBER}")
TEST_RESULT = re.compile(r"test result: \w+\. (\d+) passed; (\d+) failed; (\d+) ignored")
TEST_FAILED = re.compile(r"^test (\S+) \.\.\. .*FAILED$", re.MULTILINE)


def number(text):
    """A float, or None where JSON has no value for it."""
    value = float(text)
    return value if math.isfinite(value) else None


def numbers(match, first=1):
    return [number(text) for text in match.groups()[first - 1 :]]


def adapter(text):
    match = re.search(r"^adapter: (.*)$", text, re.MULTILINE)
    return match and match.group(1)


def kernels(text):
    """Ceilings and, for each size, stages, both kinds of steps and their kernels."""
    ceilings, sizes, of = None, [], None
    for line in text.splitlines():
        if match := CEILINGS.match(line):
            ceilings = dict(zip(["copy_gb_s", "random_reads_gb_s", "arithmetic_gflop_s"], numbers(match)))
        elif match := SIZE.fullmatch(line):
            counts = [int(group) for group in match.group(1, 2, 3, 4, 6)]
            of = None
            sizes.append(dict(zip(["gaussians", "width", "height", "visible", "anchors"], counts)))
            sizes[-1] |= {"tiles_each": number(match.group(5)), "stages": [], "kernels": {}}
        elif not sizes:
            continue
        elif match := STAGE.fullmatch(line):
            columns = ["ms", "mb", "mflop", "gb_s", "gflop_s", "share_percent"]
            sizes[-1]["stages"].append({"stage": match.group(1)} | dict(zip(columns, numbers(match, 2))))
        elif match := PLAIN_STEP.fullmatch(line):
            sizes[-1]["plain_step"] = dict(zip(["wall_ms", "steps_per_second"], numbers(match)))
        elif match := PLAIN_STEP_PARTS.fullmatch(line):
            sizes[-1]["plain_step"] |= dict(zip(["device_ms", "host_ms"], numbers(match)))
        elif match := KERNELS_OF.fullmatch(line):
            of = sizes[-1]["kernels"].setdefault(match.group(1), {})
        elif of is not None and (match := KERNEL.fullmatch(line)):
            of[match.group(1)] = number(match.group(2))
    return {"adapter": adapter(text), "ceilings": ceilings, "sizes": sizes} if sizes else None


def context(text):
    """For each number of anchors, milliseconds of the context model's kinds and their kernels."""
    sizes = []
    for line in text.splitlines():
        if match := CONTEXT.fullmatch(line):
            counts = [int(group) for group in match.group(1, 2, 3)]
            sizes.append(dict(zip(["anchors", "all_anchors", "parameters"], counts)))
            sizes[-1] |= dict(zip(["mb", "tables_ms"], numbers(match, 4))) | {"kinds": []}
        elif not sizes:
            continue
        elif sizes[-1]["kinds"] and (match := KERNEL.fullmatch(line)):
            sizes[-1]["kinds"][-1]["kernels"][match.group(1)] = number(match.group(2))
        elif match := CONTEXT_KIND.fullmatch(line):
            times = dict(zip(["forward_ms", "forward_backward_ms"], numbers(match, 2)))
            sizes[-1]["kinds"].append({"kind": match.group(1)} | times | {"kernels": {}})
    return {"adapter": adapter(text), "sizes": sizes} if sizes else None


def document(text):
    """The JSON document that a command printed among lines of progress."""
    match = re.search(r"^\{$.*?^\}$", text, re.MULTILINE | re.DOTALL)
    return json.loads(match.group()) if match else None


def train(text):
    metrics = document(text)
    if metrics is None:
        return None
    figures = {key: metrics[key] for key in METRICS if key in metrics}
    for views in ("test", "train"):
        figures[views] = metrics[views] and {key: metrics[views][key] for key in ("psnr", "ssim", "views")}
    # Both spellings: the metrics of earlier builds have the first.
    before = ["psnr_before_quantisation", "psnr_before_quantization"]
    figures["psnr_before_quantization"] = next((metrics[key] for key in before if key in metrics), None)
    if "profile" in metrics:
        figures["profile"] = metrics["profile"]
    return figures


def accuracy(text):
    found = document(text)
    if found is None:
        return None
    cases = found["cases"]
    exceeded = [f'{case["name"]}, {case["quantity"]}' for case in cases if not case["held"]]
    # An error that is not a number is null, and some bounds are zero.
    measured = [case for case in cases if case["error"] is not None and case["bound"] > 0]
    shares = [(case["error"] / case["bound"], f'{case["name"]}, {case["quantity"]}') for case in measured]
    share, name = max(shares, default=(None, None))
    figures = {"errors": len(cases), "held": len(cases) - len(exceeded), "exceeded": exceeded}
    return {"adapter": found["adapter"], **figures, "largest_share_of_bound": share, "largest_share": name}


def tests(text):
    match = TEST_RESULT.search(text)
    failed = sorted(set(TEST_FAILED.findall(text)))
    if match is None:
        return {"failed_tests": failed} if failed else None
    return dict(zip(["passed", "failed", "ignored"], map(int, match.groups()))) | {"failed_tests": failed}


def figures(kind, text, exit_status):
    """What a command's output says; None if it says nothing."""
    if kind == "compare":
        return {"same_bytes": exit_status == 0}
    if kind == "sample":
        return {}
    parsers = {
        "doctor": document,
        "views": document,
        "train": train,
        "accuracy": accuracy,
        "kernels": kernels,
        "context": context,
        "tests": tests,
    }
    try:
        return parsers[kind](text)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        # One output that is not as expected must not lose the figures of the others.
        return None


def read_run(path):
    """A command's record and figures."""
    record = dict(zip(RECORD, path.read_text(encoding="utf-8").rstrip("\n").split("\n", len(RECORD) - 1)))
    run = {"name": path.stem, "part": record["part"], "mode": record["mode"], "kind": record["kind"]}
    run |= {"command": record.get("command", ""), "began_ms": int(record["began_ms"])}
    if record["exit_status"] == "-":
        return run | {"status": "left out", "reason": record["reason"]}
    exit_status = int(record["exit_status"])
    text = path.with_suffix(".txt").read_text(encoding="utf-8", errors="replace")
    found = figures(run["kind"], text, exit_status)
    status = "ok"
    if exit_status in STOPPED:
        status = "stopped at its limit"
    elif exit_status != 0:
        status = f"failed with status {exit_status}"
    elif found is None:
        status = "failed: its output has no figures"
    return run | {"seconds": int(record["milliseconds"]) / 1000, "status": status, "figures": found}


def name_and_driver(line):
    """Name, driver and backend of `NAME (DRIVER, BACKEND)`, where both may have parentheses."""
    depth = 0
    for at in range(len(line) - 1, -1, -1):
        depth += {")": 1, "(": -1}.get(line[at], 0)
        if depth == 0 and line[at] == "(":
            driver, _, backend = line[at + 1 : -1].rpartition(", ")
            return {"adapter": line[:at].strip(), "driver": driver, "backend": backend}
    return {"adapter": line, "driver": "", "backend": ""}


def machine(runs):
    """Adapter and driver as the runs report them, and the processor."""
    lines = [run["figures"]["adapter"] for run in runs if (run.get("figures") or {}).get("adapter")]
    doctor = next((run["figures"] for run in runs if run["kind"] == "doctor" and run.get("figures")), {})
    described = name_and_driver(lines[0]) if lines else {}
    if not lines and doctor.get("adapters"):
        first = doctor["adapters"][0]
        described = {"adapter": first["name"], "driver": first["driver"], "backend": first["backend"]}
    models = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    return described | {"cores": os.cpu_count(), "processor": models[0] if models else None}


def summary(runs):
    for run in runs:
        seconds = f'{run["seconds"]:.1f} s' if "seconds" in run else ""
        reason = f': {run["reason"]}' if "reason" in run else ""
        yield f'{run["name"]:<30} {seconds:>8}  {run["status"]}{reason}'


def main():
    records, output = map(Path, sys.argv[1:])
    runs = sorted((read_run(path) for path in records.glob("*.run")), key=lambda run: (run["began_ms"], run["name"]))
    described = {
        "started": os.environ.get("GPU_DAY_STARTED"),
        "revision": os.environ.get("GPU_DAY_REVISION"),
        "limit_seconds": int(os.environ.get("GPU_DAY_SECONDS", 0)),
        "machine": machine(runs),
    }
    for run in runs:
        del run["began_ms"]
    output.write_text(json.dumps(described | {"runs": runs}, indent=1) + "\n", encoding="utf-8")
    print("\n".join(summary(runs)))
    sys.exit(any(run["status"].startswith("failed") for run in runs))


if __name__ == "__main__":
    main()
