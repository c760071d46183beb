"""One session with the client that scripts/generated_client.sh generates: a dataset in parts, a scene, a job, its events, its
file, views, an export, and everything deleted again. Every answer has to be the one that the contract promises for success.

    generated_client.py SERVER DATASET.zip STEPS
"""

import base64
import hashlib
import io
import os
import sys
import uuid
from pathlib import Path

from tcgs_client import AuthenticatedClient
from tcgs_client.api.jobs import (
    cancel_job,
    change_job,
    create_job,
    delete_job,
    estimate_job,
    export_scene,
    get_artifact,
    get_file,
    get_job,
    get_report,
    get_series,
    list_artifacts,
    list_events,
    list_jobs,
    retry_job,
)
from tcgs_client.api.scenes import create_scene, delete_scene, get_scene, list_scenes
from tcgs_client.api.service import healthz, metrics, readyz, version
from tcgs_client.api.uploads import append_to_upload, create_upload, delete_upload, get_upload, upload_options
from tcgs_client.api.views import get_view, list_cameras, render_views
from tcgs_client.models import (
    AppendToUploadTusResumable,
    ChangeJobRequest,
    CreateUploadTusResumable,
    DeleteUploadTusResumable,
    ExportSceneFormat,
    ExportSceneUp,
    FrameView,
    GetUploadTusResumable,
    JobForm,
    JobRequest,
    JobState,
    LookAtView,
    RetryRequest,
    SceneOfUpload,
    ViewsRequest,
)
from tcgs_client.types import File

ENDED = (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED)


def expect(answer, *statuses):
    if answer.status_code not in statuses:
        sys.exit(f"{statuses} was expected, and {int(answer.status_code)} came: {answer.content[:500]!r}")
    return answer


def cancel(client, job):
    """Cancels a job and waits for its end: at once if it is queued, soon if a worker has taken it."""
    expect(cancel_job.sync_detailed(job.id, client=client), 200, 202)
    while expect(get_job.sync_detailed(job.id, client=client, prefer="wait=30"), 200).parsed.state not in ENDED:
        pass


def upload(client, archive):
    """Sends an archive in two parts."""
    expect(upload_options.sync_detailed(client=client), 204)
    begun = create_upload.sync_detailed(
        client=client, upload_length=len(archive), tus_resumable=CreateUploadTusResumable.VALUE_0
    )
    identity = uuid.UUID(expect(begun, 201).headers["Location"].rpartition("/")[2])
    middle = len(archive) // 2
    for begin, end in ((0, middle), (middle, len(archive))):
        so_far = get_upload.sync_detailed(identity, client=client, tus_resumable=GetUploadTusResumable.VALUE_0)
        assert int(expect(so_far, 200).headers["Upload-Offset"]) == begin
        piece = archive[begin:end]
        checksum = "sha256 " + base64.b64encode(hashlib.sha256(piece).digest()).decode()
        sent = append_to_upload.sync_detailed(
            identity,
            client=client,
            body=File(payload=io.BytesIO(piece)),
            upload_offset=begin,
            upload_checksum=checksum,
            tus_resumable=AppendToUploadTusResumable.VALUE_0,
        )
        assert int(expect(sent, 204).headers["Upload-Offset"]) == end
    return identity


def give_up_an_upload(client):
    begun = create_upload.sync_detailed(client=client, upload_length=10, tus_resumable=CreateUploadTusResumable.VALUE_0)
    identity = uuid.UUID(expect(begun, 201).headers["Location"].rpartition("/")[2])
    gone = delete_upload.sync_detailed(identity, client=client, tus_resumable=DeleteUploadTusResumable.VALUE_0)
    expect(gone, 204)


def follow(client, job):
    """Waits for the job's end, and reads its events on the way."""
    seen = 0
    while True:
        now = expect(get_job.sync_detailed(job, client=client, prefer="wait=30"), 200).parsed
        page = expect(list_events.sync_detailed(job, client=client, after=seen), 200).parsed
        for event in page.events:
            assert event.seq == seen + 1, f"event {event.seq} follows {seen}"
            seen = event.seq
        if now.state in ENDED:
            assert now.state == JobState.SUCCEEDED, now.error
            assert seen > 0
            return now


def main():
    server, dataset, steps = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    client = AuthenticatedClient(base_url=server, token=os.environ["TCGS_API_KEY"], timeout=600.0)
    expect(healthz.sync_detailed(client=client), 200)
    expect(readyz.sync_detailed(client=client), 200)
    assert expect(version.sync_detailed(client=client), 200).parsed.api == "v1"

    archive = dataset.read_bytes()
    give_up_an_upload(client)
    made = create_scene.sync_detailed(client=client, body=SceneOfUpload(upload_id=upload(client, archive)))
    scene = expect(made, 201).parsed
    again = create_scene.sync_detailed(client=client, body=File(payload=io.BytesIO(archive)))
    assert expect(again, 200).parsed.id == scene.id, "a dataset is one scene"
    assert expect(get_scene.sync_detailed(scene.id, client=client), 200).parsed.summary.train > 0
    assert len(expect(list_scenes.sync_detailed(client=client), 200).parsed.scenes) == 1

    key = str(uuid.uuid4())
    wish = JobRequest(scene_id=scene.id, iterations=steps)
    estimate = expect(estimate_job.sync_detailed(client=client, body=wish), 200).parsed
    assert estimate.steps == steps and estimate.train_seconds is None, "no job has finished"
    assert estimate.memory.gpu_bytes > 0 and estimate.file_bytes.low <= estimate.file_bytes.high
    job = expect(create_job.sync_detailed(client=client, body=wish, idempotency_key=key), 201).parsed
    repeated = create_job.sync_detailed(client=client, body=wish, idempotency_key=key)
    assert expect(repeated, 201).parsed.id == job.id, "a repeated request makes nothing again"
    finished = follow(client, job.id)
    assert finished.metrics.steps == steps and finished.options.iterations == steps
    estimate = expect(estimate_job.sync_detailed(client=client, body=wish), 200).parsed
    assert estimate.finished_jobs.count == 1 and estimate.seconds.low < estimate.seconds.high
    expect(get_series.sync_detailed(job.id, client=client), 200)
    expect(get_report.sync_detailed(job.id, client=client), 200)
    assert [one.id for one in expect(list_jobs.sync_detailed(client=client), 200).parsed.jobs] == [job.id]

    file = expect(get_artifact.sync_detailed(job.id, client=client), 200).content
    digest = finished.artifacts[0].sha256
    assert hashlib.sha256(file).hexdigest() == digest
    assert expect(get_file.sync_detailed(digest, client=client), 200).content == file
    part = expect(get_artifact.sync_detailed(job.id, client=client, range_="bytes=4-9"), 206).content
    assert part == file[4:10]
    export = expect(export_scene.sync_detailed(job.id, client=client, format_=ExportSceneFormat.SPZ), 200).content
    assert export.startswith(b"NGSP")
    upright = export_scene.sync_detailed(
        job.id, client=client, format_=ExportSceneFormat.PLY, up=ExportSceneUp.Y, scale=0.5
    )
    assert expect(upright, 200).content.startswith(b"ply")
    kinds = [one.kind.value for one in expect(list_artifacts.sync_detailed(job.id, client=client), 200).parsed.artifacts]
    assert "tcgs" in kinds and "spz" in kinds, kinds

    frame = finished.metrics.test.per_view[0].name
    view = expect(get_view.sync_detailed(job.id, client=client, frame=frame), 200).content
    assert view.startswith(b"\x89PNG")
    posed = get_view.sync_detailed(job.id, client=client, position="3,0,1", look_at="0,0,0", width=64, height=48)
    assert expect(posed, 200).content.startswith(b"\x89PNG")
    wish = ViewsRequest(views=[FrameView(frame=frame)])
    assert expect(render_views.sync_detailed(job.id, client=client, body=wish), 200).content == view
    # Without a camera, by position, and by a camera of the dataset.
    small = expect(get_view.sync_detailed(job.id, client=client, width=32), 200).content
    assert small.startswith(b"\x89PNG") and len(small) < len(view)
    at = ViewsRequest(views=[LookAtView(position=[3, 0, 1], look_at=[0, 0, 0], width=64, height=48)])
    assert expect(render_views.sync_detailed(job.id, client=client, body=at), 200).content == posed.content
    cameras = expect(list_cameras.sync_detailed(job.id, client=client), 200).parsed.cameras
    same = next(camera.view for camera in cameras if camera.name == frame)
    wish = ViewsRequest(views=[same])
    assert expect(render_views.sync_detailed(job.id, client=client, body=wish), 200).content == view
    assert b"tcgs_" in expect(metrics.sync_detailed(client=client), 200).content

    changed = change_job.sync_detailed(job.id, client=client, body=ChangeJobRequest(name="first"))
    assert expect(changed, 200).parsed.name == "first"
    part = expect(get_job.sync_detailed(job.id, client=client, fields="id,metrics.test.psnr"), 200).parsed
    assert part.to_dict() == {"id": str(job.id), "metrics": {"test": {"psnr": finished.metrics.test.psnr}}}, part

    # The archive in a form; its dataset serves the next job by its id.
    form = JobForm(file=File(payload=io.BytesIO(archive), file_name="scene.zip", mime_type="application/zip"))
    form["iterations"] = "1000000"
    sent = expect(create_job.sync_detailed(client=client, body=form), 201).parsed
    assert sent.options.iterations == 1_000_000 and sent.dataset_id == scene.id
    cancel(client, sent)
    repeated = retry_job.sync_detailed(sent.id, client=client, body=RetryRequest(lambda_=0.002, iterations=1_000_000))
    repeated = expect(repeated, 201).parsed
    assert repeated.options.lambda_ == 0.002 and repeated.retry_of == sent.id
    cancel(client, repeated)
    for one in (sent, repeated):
        expect(delete_job.sync_detailed(one.id, client=client), 204)

    other = create_job.sync_detailed(client=client, body=File(payload=io.BytesIO(archive)), iterations=1_000_000)
    expect(retry_job.sync_detailed(job.id, client=client), 409)
    other = expect(other, 201).parsed
    cancel(client, other)
    for one in (other, job):
        expect(delete_job.sync_detailed(one.id, client=client), 204)
    expect(delete_scene.sync_detailed(scene.id, client=client), 204)
    expect(get_job.sync_detailed(job.id, client=client), 404)
    assert expect(list_scenes.sync_detailed(client=client), 200).parsed.scenes == []
    print(f"the generated client has gone through a session: {len(file)} bytes after {steps} steps")


main()
