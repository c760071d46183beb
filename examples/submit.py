#!/usr/bin/env python3
"""Sends a zip of photographs, waits for its scene and saves it: python3 examples/submit.py scene.zip scene.tcgs

examples/client.py does the same over connections that break. A key, where the service wants one, is read from TCGS_API_KEY."""

import os
import sys

import requests

dataset, output = sys.argv[1:3]
server = os.environ.get("TCGS_SERVER", "http://127.0.0.1:8080")
headers = {"Authorization": f"Bearer {os.environ['TCGS_API_KEY']}"} if "TCGS_API_KEY" in os.environ else {}


def ask(method, path, **options):
    answer = requests.request(method, server + path, headers={**headers, "Prefer": "wait=60"}, timeout=600, **options)
    return answer if answer.ok else sys.exit(f"{method} {path}: {answer.text}")


with open(dataset, "rb") as file:
    job = ask("POST", "/v1/jobs", files={"file": file}, data={"preset": "preview", "iterations": 300}).json()
while job["state"] in ("queued", "running"):
    job = ask("GET", job["links"]["self"]).json()
if job["state"] != "succeeded":
    sys.exit(f"the job {job['state']}: {job['error']}")
with open(output, "wb") as file:
    file.write(ask("GET", job["links"]["artifact"]).content)
print(f"{output}: {job['metrics']['bytes']['total']} bytes, {job['metrics']['test']['psnr']:.2f} dB")
