#!/usr/bin/env python3
"""From a dataset to a compressed scene and a view of it, with nothing but the requests library.

    python3 examples/client.py scene.zip --frame images/view_06.png --option iterations=400

The dataset is sent in parts (tus 1.0.0) and gone on with after a broken connection, the job is followed by its stream of
events, the file is downloaded by ranges and held to the digest that the service states. A key, where the service wants one, is
read from TCGS_API_KEY.
"""

import argparse
import base64
import hashlib
import json
import os
import sys
import time
import uuid

import requests

PART = 8 << 20
TRIES = 8
TERMINAL = {"succeeded", "failed", "cancelled"}


class Refused(Exception):
    """The service said no; its problem document says why."""


class Service:
    def __init__(self, base):
        self.base = base.rstrip("/")
        self.session = requests.Session()
        key = os.environ.get("TCGS_API_KEY", "").strip()
        if key:
            self.session.headers["Authorization"] = f"Bearer {key}"

    def ask(self, method, path, ok=(), **options):
        """One request. An answer that is neither success nor in `ok` raises what it tells of."""
        options.setdefault("timeout", 120)
        answer = self.session.request(method, self.base + path, allow_redirects=False, **options)
        if not answer.ok and answer.status_code not in ok:
            try:
                problem = answer.json()
                said = f"{problem['title']}: {problem['detail']}"
            except (ValueError, KeyError):
                said = answer.text[:200]
            raise Refused(f"{method} {path}: {answer.status_code} {said}")
        return answer


def upload(service, path, part=PART):
    """Sends a zip in parts and gives the id of the scene that is made of it."""
    tus = {"Tus-Resumable": "1.0.0"}
    size = os.path.getsize(path)
    begun = service.ask("POST", "/v1/uploads", headers={**tus, "Upload-Length": str(size)})
    place = begun.headers["Location"]
    offset, breaks = 0, 0
    with open(path, "rb") as archive:
        while offset < size:
            archive.seek(offset)
            piece = archive.read(part)
            checksum = base64.b64encode(hashlib.sha256(piece).digest()).decode()
            headers = {
                **tus,
                "Upload-Offset": str(offset),
                "Upload-Checksum": f"sha256 {checksum}",
                "Content-Type": "application/offset+octet-stream",
            }
            try:
                # 409: the service has another part of it; 423: it still takes the last one; 460: the sum was wrong.
                again = (409, 423, 429, 460, 503)
                answer = service.ask("PATCH", place, ok=again, headers=headers, data=piece)
                if answer.status_code not in again:
                    offset, breaks = int(answer.headers["Upload-Offset"]), 0
                    print(f"sent {offset} of {size} bytes", file=sys.stderr)
                    continue
            except requests.ConnectionError:
                pass
            breaks += 1
            if breaks > TRIES:
                raise Refused(f"the upload broke off at byte {offset} of {size}")
            time.sleep(0.5 * breaks)
            offset = int(service.ask("HEAD", place, headers=tus).headers["Upload-Offset"])
    wish = {"upload_id": place.rsplit("/", 1)[1]}
    return service.ask("POST", "/v1/scenes", json=wish).json()["id"]


def submit(service, scene, options):
    """Makes a job of a scene. The key lets the request be repeated without making a second one."""
    headers = {"Idempotency-Key": str(uuid.uuid4())}
    return service.ask("POST", "/v1/jobs", headers=headers, json={"scene_id": scene, **options}).json()


def events(lines):
    """The events in the lines of a stream, as (id, data)."""
    number, data = None, []
    for line in lines:
        if line:
            field, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if field == "id":
                number = value
            elif field == "data":
                data.append(value)
        elif data:
            yield number, json.loads("\n".join(data))
            data = []


def follow(service, job):
    """Prints how a job goes until it has ended, and gives it as it is then."""
    last, breaks = "0", 0
    while breaks <= TRIES:
        headers = {"Accept": "text/event-stream", "Last-Event-ID": last}
        try:
            stream = service.ask("GET", f"/v1/jobs/{job}/events", headers=headers, stream=True)
            if stream.status_code == 204:
                break
            stream.encoding = "utf-8"
            for last, event in events(stream.iter_lines(decode_unicode=True)):
                breaks = 0
                show(event)
        except requests.ConnectionError:
            breaks += 1
        finished = service.ask("GET", f"/v1/jobs/{job}").json()
        if finished["state"] in TERMINAL:
            break
        time.sleep(0.5)
    finished = service.ask("GET", f"/v1/jobs/{job}").json()
    if finished["state"] != "succeeded":
        raise Refused(f"job {job} is {finished['state']}: {finished['error']}")
    return finished


def show(event):
    if "kind" not in event:
        # Not the job's: the stream says why it ends.
        return
    data = event["data"]
    if event["kind"] == "progress":
        known = [f"{name} {data[name]:.4g}" for name in ("loss", "psnr") if data[name] is not None]
        print(f"step {data['step']} of {data['total']}", *known, file=sys.stderr)
    else:
        print(event["kind"], data.get("state") or data.get("phase") or data, file=sys.stderr)


def download(service, artifact, path):
    """Brings a file, goes on with what is there of it, and keeps it only if its digest is right."""
    part, size = f"{path}.part", artifact["bytes"]
    have = os.path.getsize(part) if os.path.exists(part) else 0
    if have > size:
        have = 0
    for _ in range(TRIES):
        if have == size:
            break
        headers = {"Range": f"bytes={have}-", "If-Range": f'"{artifact["sha256"]}"'} if have else {}
        try:
            answer = service.ask("GET", artifact["href"], headers=headers, stream=True)
            digest = base64.b64encode(bytes.fromhex(artifact["sha256"])).decode()
            if answer.headers["Repr-Digest"] != f"sha-256=:{digest}:":
                raise Refused(f"{path}: the service states another digest than the job")
            if answer.status_code != 206:
                have = 0
            with open(part, "r+b" if have else "wb") as file:
                file.seek(have)
                for piece in answer.iter_content(1 << 16):
                    file.write(piece)
        except requests.ConnectionError:
            time.sleep(0.5)
        have = os.path.getsize(part) if os.path.exists(part) else 0
    digest = hashlib.sha256()
    with open(part, "rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    if digest.hexdigest() != artifact["sha256"]:
        os.remove(part)
        raise Refused(f"{path}: the file came as {digest.hexdigest()}, not as {artifact['sha256']}")
    os.replace(part, path)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="a zip of posed photographs")
    parser.add_argument("--server", default="http://127.0.0.1:8080")
    parser.add_argument("--output", default="scene.tcgs", help="the file to write")
    parser.add_argument("--view", default="view.png", help="the picture to write")
    parser.add_argument("--frame", required=True, help="name of the dataset image whose camera to view from")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE", help="a training option")
    parser.add_argument("--part", type=int, default=PART, help="bytes sent at a time")
    arguments = parser.parse_args()
    options = {}
    for option in arguments.option:
        name, _, value = option.partition("=")
        try:
            options[name] = json.loads(value)
        except ValueError:
            options[name] = value

    service = Service(arguments.server)
    scene = upload(service, arguments.dataset, arguments.part)
    job = submit(service, scene, options)
    print(f"job {job['id']}", file=sys.stderr)
    finished = follow(service, job["id"])
    download(service, finished["artifacts"][0], arguments.output)
    view = service.ask("GET", finished["links"]["view"], params={"frame": arguments.frame, "format": "png"})
    with open(arguments.view, "wb") as file:
        file.write(view.content)
    test = finished["metrics"]["test"]
    print(json.dumps({"job": job["id"], "bytes": finished["metrics"]["bytes"]["total"], "psnr": test["psnr"]}))


if __name__ == "__main__":
    try:
        main()
    except (Refused, requests.RequestException) as fault:
        sys.exit(f"client: {fault}")
