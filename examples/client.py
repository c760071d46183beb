#!/usr/bin/env python3
"""From a dataset to a compressed scene and a view of it, with nothing but the requests library.

    python3 examples/client.py scene.zip --frame images/view_06.png --option iterations=400

The dataset is sent in parts (tus 1.0.0), the job is followed by its stream of events, and the file is downloaded by ranges and
checked against its digest. A connection may break at any byte: uploads, events and downloads continue where they stopped, and
every other request is repeated. The service's Retry-After is honored. A key, where the service wants one, is read from
TCGS_API_KEY.
"""

import argparse
import base64
import hashlib
import json
import os
import sys
import time
import uuid
from email.utils import parsedate_to_datetime

import requests

PART = 8 << 20
TRIES = 8
# Slowest connection on which a part is sent to its end, in bytes per second.
SLOWEST = 32 << 10
# How long a request is repeated while an earlier one for the same thing is still being answered, in seconds.
UNDER_WAY = 600
TERMINAL = {"succeeded", "failed", "cancelled"}
# Options by which a dataset is checked before there is a job.
READING = ("skip_missing", "masks", "mask_mode")

# Too many requests, and a service or proxy that is busy or starts again: the same request may succeed later.
LATER = {429, 502, 503, 504}

# A connection that was refused, lost, or lost within an answer.
BROKEN = (
    requests.ConnectionError,
    requests.Timeout,
    requests.exceptions.ChunkedEncodingError,
    requests.exceptions.ContentDecodingError,
)


class Refused(Exception):
    """The service said no; its problem document says why."""


class Cut(requests.ConnectionError):
    """An answer ended before it was whole, in a place where the library does not notice."""


class Service:
    def __init__(self, base, pause=0.5):
        self.base = base.rstrip("/")
        self.pause = pause
        self.session = requests.Session()
        key = os.environ.get("TCGS_API_KEY", "").strip()
        if key:
            self.session.headers["Authorization"] = f"Bearer {key}"

    def once(self, method, path, **options):
        """One request and its answer, whatever its status."""
        # The library counts sending a body as one step, so its time grows with the body. A dataset is checked before it is answered.
        sending = len(options.get("data") or b"") / SLOWEST
        options.setdefault("timeout", sending + (600 if method == "POST" else 120))
        answer = self.session.request(method, self.base + path, allow_redirects=False, **options)
        length = answer.headers.get("Content-Length")
        bodiless = method == "HEAD" or answer.status_code in (204, 304)
        if not bodiless and "Transfer-Encoding" not in answer.headers and not (length or "").isdigit():
            raise Cut(f"{method} {path}: the answer's headers were cut off")
        plain = not bodiless and not options.get("stream") and "Content-Encoding" not in answer.headers
        if length and plain and len(answer.content) != int(length):
            raise Cut(f"{method} {path}: the answer's body was cut off")
        return answer

    def wait(self, tries, answer=None):
        """Sleeps as long as the answer asks, or else longer from try to try."""
        asked = retry_after(answer)
        if asked is not None:
            print(f"the service asks to wait {asked:g} s", file=sys.stderr)
        time.sleep(self.pause * 2 ** min(tries, 6) if asked is None else asked)

    def ask(self, method, path, ok=(), whole=None, **options):
        """An answer that is a success or in `ok`; other ones raise what their problem says.

        Broken connections and statuses that ask to come again are tried again, so a request that makes something needs an
        Idempotency-Key. `whole` looks at an answer whose headers matter, and raises ValueError if they came in part."""
        fault, tries, until = None, 0, time.monotonic() + UNDER_WAY
        while tries < TRIES:
            answer = None
            try:
                answer = self.once(method, path, **options)
                if answer.status_code in ok:
                    return answer
                if answer.ok:
                    if whole:
                        whole(answer)
                    return answer
                fault = Refused(f"{method} {path}: {answer.status_code} {said(answer)}")
                if under_way(answer) and time.monotonic() < until:
                    time.sleep(min(self.pause * 4, 5))
                    continue
                if answer.status_code not in LATER:
                    raise fault
            except BROKEN as broken:
                fault = broken
            except requests.RequestException:
                raise
            except ValueError as part:
                fault = Cut(f"{method} {path}: {part}")
            tries += 1
            if tries < TRIES:
                self.wait(tries - 1, answer)
        raise fault


def said(answer):
    try:
        problem = answer.json()
        return f"{problem['title']}: {problem['detail']}"
    except (ValueError, KeyError, TypeError):
        return answer.text[:200]


def under_way(answer):
    """Whether an earlier request with the same Idempotency-Key, or for the same upload, is still being answered."""
    kinds = ("problem:idempotency-in-flight", "problem:upload-locked")
    return answer.status_code == 409 and any(kind in answer.text for kind in kinds)


def retry_after(answer):
    """Seconds that an answer asks to wait: a number, or an instant in HTTP's form."""
    text = answer.headers.get("Retry-After", "").strip() if answer is not None and not answer.ok else ""
    if text.isdigit():
        return int(text)
    try:
        return max(0.0, parsedate_to_datetime(text).timestamp() - time.time())
    except (TypeError, ValueError):
        return None


def make(service, path, wish):
    """Makes something of a JSON object. The key, fresh for each thing, lets the request be repeated without making a second one."""
    headers = {"Idempotency-Key": str(uuid.uuid4())}
    return service.ask("POST", path, headers=headers, json=wish).json()


def upload(service, path, part=PART, reading=None):
    """Sends a zip in parts and returns the id of the dataset that is made of it. `reading` has the options that its check needs too."""
    tus = {"Tus-Resumable": "1.0.0"}
    size = os.path.getsize(path)

    def identity(answer):
        return str(uuid.UUID(answer.headers.get("Location", "").rpartition("/")[2]))

    # If the answer is lost, the repetition begins another upload; the service gives the first up when nothing is sent to it.
    begun = service.ask("POST", "/v1/uploads", headers={**tus, "Upload-Length": str(size)}, whole=identity)
    upload_id = identity(begun)
    place = f"/v1/uploads/{upload_id}"

    def offset_of(answer):
        offset = int(answer.headers.get("Upload-Offset", ""))
        if offset > size:
            raise ValueError(f"Upload-Offset {offset} is beyond the end")
        return offset

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
            before, answer = offset, None
            try:
                answer = service.once("PATCH", place, headers=headers, data=piece)
                # 409: the service has another part of it; 423: it still takes the last one; 460: the sum was wrong.
                if not answer.ok and answer.status_code not in LATER | {409, 423, 460}:
                    raise Refused(f"PATCH {place}: {answer.status_code} {said(answer)}")
            except BROKEN:
                pass
            if answer is None or not answer.ok:
                service.wait(breaks, answer)
            # What the service has, not what this side believes to have sent.
            offset = offset_of(service.ask("HEAD", place, headers=tus, whole=offset_of))
            if offset > before:
                breaks = 0
                print(f"sent {offset} of {size} bytes", file=sys.stderr)
            else:
                breaks += 1
                if breaks > TRIES:
                    raise Refused(f"the upload broke off at byte {offset} of {size}")
    return make(service, "/v1/datasets", {"upload_id": upload_id, **(reading or {})})["id"]


def events(lines):
    """The events in the lines of a stream, as (id, data). One that was cut off has no empty line behind it, and is left out."""
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
    """Prints how a job proceeds until it has ended, and returns it as it is then."""
    last, breaks = "0", 0
    while breaks <= TRIES:
        before = last
        headers = {"Accept": "text/event-stream", "Last-Event-ID": last}
        try:
            stream = service.ask("GET", f"/v1/jobs/{job}/events", headers=headers, stream=True)
            stream.encoding = "utf-8"
            for last, event in events(stream.iter_lines(decode_unicode=True)):
                show(event)
        except BROKEN:
            pass
        now = service.ask("GET", f"/v1/jobs/{job}").json()
        if now["state"] in TERMINAL:
            if now["state"] != "succeeded":
                raise Refused(f"job {job} is {now['state']}: {now['error']}")
            return now
        breaks = 0 if last != before else breaks + 1
        service.wait(breaks)
    raise Refused(f"the events of job {job} broke off {breaks} times in a row after event {last}")


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
    """Downloads a file, continues one that broke off, and keeps it only if its digest is right."""
    # Named by its content, so that a part of another file is never continued.
    part, size = f"{path}.{artifact['sha256'][:16]}.part", artifact["bytes"]

    def length():
        return os.path.getsize(part) if os.path.exists(part) else 0

    breaks = 0
    while length() != size:
        have = length() if length() < size else 0
        headers = {"Range": f"bytes={have}-", "If-Range": f'"{artifact["sha256"]}"'} if have else {}
        try:
            answer = service.ask("GET", artifact["href"], headers=headers, stream=True)
            if answer.status_code != 206:
                have = 0
            with open(part, "r+b" if have else "wb") as file:
                file.seek(have)
                for piece in answer.iter_content(1 << 16):
                    file.write(piece)
        except BROKEN:
            pass
        breaks = 0 if length() > have else breaks + 1
        if breaks > TRIES:
            raise Refused(f"{path}: the download broke off at byte {length()} of {size}")
        if length() != size:
            service.wait(breaks)
    digest = hashlib.sha256()
    with open(part, "rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    if digest.hexdigest() != artifact["sha256"]:
        os.remove(part)
        raise Refused(f"{path}: the file has the digest {digest.hexdigest()}, and the job states {artifact['sha256']}")
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
    parser.add_argument("--pause", type=float, default=0.5, help="seconds before a first repetition; doubled at each further one")
    arguments = parser.parse_args()
    options = {}
    for option in arguments.option:
        name, _, value = option.partition("=")
        try:
            options[name] = json.loads(value)
        except ValueError:
            options[name] = value

    service = Service(arguments.server, arguments.pause)
    reading = {name: options[name] for name in READING if name in options}
    dataset = upload(service, arguments.dataset, arguments.part, reading)
    job = make(service, "/v1/jobs", {"dataset_id": dataset, **options})
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
    except (Refused, OSError) as fault:  # OSError: of files, and of requests
        sys.exit(f"client: {fault}")
