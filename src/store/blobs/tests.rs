use super::*;
use crate::domain::{Clock as _, SystemClock};

async fn staged(blobs: &Blobs, content: &[u8]) -> StagedBlob {
    let mut staging = blobs.stage(1 << 30).await.expect("room");
    for piece in content.chunks(3) {
        staging.write(piece).await.expect("a write");
    }
    staging.finish().await.expect("an end")
}

#[tokio::test]
async fn a_published_blob_reads_back_whole_and_in_parts() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let upload = staged(&blobs, b"twelve bytes").await;
    let blob = blobs.publish(&upload).await.expect("published");
    let blob = blob.blob;
    assert_eq!(blob, BlobRef { digest: Digest::of(b"twelve bytes"), bytes: 12 });
    assert_eq!(blobs.publish(&upload).await.expect("published again").blob, blob);
    assert_eq!(blobs.put(Bytes::from_static(b"twelve bytes")).await.expect("the same"), blob);
    assert_eq!(&blobs.read(blob.digest).await.expect("whole")[..], b"twelve bytes");
    let part: Vec<Bytes> =
        blobs.stream_part(blob.digest, 7..12).await.expect("part").try_collect().await.expect("bytes");
    assert_eq!(part.concat(), b"bytes");
    let file = blobs.local_copy(blob.digest).await.expect("a file");
    assert_eq!(std::fs::read(file.path()).expect("readable"), b"twelve bytes");
    let path = upload.path().to_owned();
    drop(upload);
    assert!(!path.exists(), "a staging file must not outlive its handle");
}

#[cfg(unix)]
#[tokio::test]
async fn a_staged_file_becomes_a_blob_without_a_copy() {
    use std::os::unix::fs::MetadataExt as _;

    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let upload = staged(&blobs, b"twelve bytes").await;
    let staged_as = std::fs::metadata(upload.path()).expect("there").ino();
    let blob = blobs.publish(&upload).await.expect("published").blob;
    drop(upload);
    let file = blobs.local_copy(blob.digest).await.expect("a file");
    let metadata = std::fs::metadata(file.path()).expect("there");
    assert_eq!((metadata.ino(), metadata.nlink()), (staged_as, 1), "one file, now by its own name alone");
}

#[tokio::test]
async fn a_blob_that_was_cut_off_is_mended_by_the_next_publication() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let content = Bytes::from_static(b"twelve bytes");
    let blob = blobs.put(content.clone()).await.expect("published");
    let cut = async || {
        let file = blobs.local_copy(blob.digest).await.expect("a file");
        std::fs::write(file.path(), &content[..5]).expect("writable");
        assert!(blobs.republish(blob).await.expect("asked").is_none(), "it is not the blob");
    };
    cut().await;
    let mended = blobs.put_new(content.clone()).await.expect("published");
    assert_eq!(blobs.read(blob.digest).await.expect("whole"), content);
    assert!(!blobs.unpublish(mended).await.expect("asked"), "who relied on it before still does");
    cut().await;
    blobs.publish(&staged(&blobs, &content).await).await.expect("published");
    assert_eq!(blobs.read(blob.digest).await.expect("whole"), content);
}

/// As where the file system has no links, or blobs are on another one.
#[cfg(target_os = "linux")]
#[tokio::test]
async fn a_staged_file_that_cannot_be_linked_is_copied() {
    use std::os::unix::fs::MetadataExt as _;

    let [folder, elsewhere] = [tempfile::tempdir(), tempfile::tempdir_in("/dev/shm")];
    let (Ok(folder), Ok(elsewhere)) = (folder, elsewhere) else { return };
    let device = |path: &Path| std::fs::metadata(path).expect("there").dev();
    if device(folder.path()) == device(elsewhere.path()) {
        return;
    }
    std::os::unix::fs::symlink(elsewhere.path(), folder.path().join("staging")).expect("linked");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let upload = staged(&blobs, b"twelve bytes").await;
    let published = blobs.publish(&upload).await.expect("published");
    let path = blobs.local_copy(published.blob.digest).await.expect("a file").path().to_owned();
    assert!(device(&path) != device(upload.path()));
    drop(upload);
    assert_eq!(&blobs.read(published.blob.digest).await.expect("whole")[..], b"twelve bytes");
    assert!(!blobs.unpublish(published).await.expect("asked"), "another may have copied the same");
}

#[tokio::test]
async fn what_a_crash_left_of_a_copy_is_removed_once_it_is_old() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let blob = blobs.put(Bytes::from_static(b"twelve bytes")).await.expect("published");
    let path = blobs.local_copy(blob.digest).await.expect("a file").path().to_owned();
    let beside = |name: &str| path.with_file_name(name);
    let (of_a_copy, foreign) = (beside(&format!("{}#1", blob.digest)), beside("notes"));
    for path in [&of_a_copy, &foreign] {
        std::fs::write(path, b"half").expect("written");
    }
    let age = SignedDuration::from_hours(1);
    let now = SystemClock.now();
    assert_eq!(blobs.older_than(age, now).await.expect("a list").all().expect("all"), []);
    assert!(of_a_copy.exists(), "it may still be written");
    let later = now + SignedDuration::from_hours(2);
    let old = blobs.older_than(age, later).await.expect("a list").all();
    assert_eq!(old.expect("all"), [blob.digest]);
    assert!(!of_a_copy.exists() && foreign.exists(), "nobody knows what the other is");
}

#[tokio::test]
async fn a_publication_is_undone_only_if_it_created_the_blob_and_none_followed() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let is_there = async |published: Published| blobs.local_copy(published.blob.digest).await.is_ok();
    let content = Bytes::from_static(b"twelve bytes");
    let put = blobs.put_new(content.clone()).await.expect("published");
    assert!(blobs.unpublish(put).await.expect("asked") && !is_there(put).await);
    assert!(!blobs.unpublish(put).await.expect("asked"), "it is gone");

    let upload = staged(&blobs, &content).await;
    let first = blobs.publish(&upload).await.expect("published");
    let second = blobs.put_new(content.clone()).await.expect("published again");
    assert!(!blobs.unpublish(first).await.expect("asked"), "another counts on it");
    assert!(!blobs.unpublish(second).await.expect("asked"), "it was there before");
    assert!(is_there(first).await);
    let again = blobs.republish(first.blob).await.expect("asked").expect("there");
    assert_eq!(std::fs::read(again.1.path()).expect("readable"), &content[..]);
    let absent = BlobRef { digest: Digest::of(b"absent"), bytes: 6 };
    assert!(blobs.republish(absent).await.expect("asked").is_none());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_publications_at_the_same_time_none_can_be_undone() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    for turn in 0..50 {
        let content = Bytes::from(format!("content {turn}"));
        let publish = || {
            let (blobs, content) = (blobs.clone(), content.clone());
            tokio::spawn(async move { blobs.put_new(content).await.expect("published") })
        };
        let mut published = Vec::new();
        for publishing in [publish(), publish(), publish()] {
            published.push(publishing.await.expect("no panic"));
        }
        for one in published {
            assert!(!blobs.unpublish(one).await.expect("asked"), "turn {turn}: the others count on it");
        }
        assert_eq!(blobs.read(Digest::of(&content)).await.expect("there"), content);
    }
}

#[tokio::test]
async fn content_that_is_not_kept_is_hashed_too() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let mut staging = blobs.stage(1 << 30).await.expect("room");
    staging.write(b"twelve").await.expect("a write");
    let files = || std::fs::read_dir(blobs.0.staging_dir.path()).expect("a folder").count();
    let before = files();
    let mut content = staging.into_hasher(12).await.expect("forgotten");
    assert_eq!(files(), before - 1);
    content.update(b" bytes").expect("as long as may be");
    assert!(matches!(content.update(b"!"), Err(BlobError::TooLarge { limit: 12 })));
    let mut content = ContentHasher::new(12);
    content.update(b"twelve bytes").expect("as long as may be");
    assert_eq!(content.finish(), BlobRef { digest: Digest::of(b"twelve bytes"), bytes: 12 });
}

#[tokio::test]
async fn limits_damage_and_absence_are_different_errors() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let mut staging = blobs.stage(4).await.expect("room");
    staging.write(b"four").await.expect("exactly the limit");
    assert!(matches!(staging.write(b"!").await, Err(BlobError::TooLarge { limit: 4 })));
    let absent = Digest::of(b"absent");
    assert!(matches!(blobs.read(absent).await, Err(BlobError::Missing(digest)) if digest == absent));
    assert!(matches!(blobs.local_copy(absent).await, Err(BlobError::Missing(_))));
    let blob = blobs.put(Bytes::from_static(b"sound")).await.expect("published");
    let file = blobs.local_copy(blob.digest).await.expect("a file");
    std::fs::write(file.path(), b"rotten").expect("writable");
    assert!(matches!(blobs.read(blob.digest).await, Err(BlobError::Damaged { .. })));
    assert!(blobs.free_bytes().expect("known") > 0);
}

#[tokio::test]
async fn an_upload_resumes_after_the_received_bytes_and_becomes_a_blob_without_a_copy() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let id = UploadId(uuid::Uuid::from_u128(1));
    let mut file = blobs.open_upload(id).await.expect("opens").expect("free");
    file.write(b"twelve ").await.expect("a write");
    file.sync().await.expect("on disk");
    file.write(b"and what the table never heard of").await.expect("a write");
    file.sync().await.expect("on disk");
    drop(file);
    assert_eq!(blobs.uploads().await.expect("a list"), [id]);
    let mut file = blobs.open_upload(id).await.expect("opens").expect("free");
    assert!(matches!(
        file.continue_at(41).await,
        Err(BlobError::UploadDamaged { expected: 41, found: 40, .. })
    ));
    file.continue_at(7).await.expect("at the end of what was received");
    file.write(b"bytes").await.expect("a write");
    file.sync().await.expect("on disk");
    drop(file);
    let reopen = || async { blobs.open_upload(id).await.expect("opens").expect("free") };
    assert!(matches!(reopen().await.finish(13).await, Err(BlobError::UploadDamaged { found: 12, .. })));
    let staged = reopen().await.finish(12).await.expect("whole");
    assert!(blobs.open_upload(id).await.expect("asked").is_none(), "nobody writes while it is used");
    let blob = blobs.publish(&staged).await.expect("published").blob;
    assert_eq!(&blobs.read(blob.digest).await.expect("whole")[..], b"twelve bytes");
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt as _;
        let file = blobs.local_copy(blob.digest).await.expect("a file");
        let [one, other] = [file.path(), staged.path()].map(|path| std::fs::metadata(path).expect("there"));
        assert_eq!(one.ino(), other.ino());
    }
    assert!(!blobs.remove_upload(id).await.expect("asked"), "it is held");
    drop(staged);
    assert!(blobs.remove_upload(id).await.expect("asked"));
    assert!(blobs.remove_upload(id).await.expect("asked"), "what is gone is gone");
    assert_eq!(&blobs.read(blob.digest).await.expect("the blob stays")[..], b"twelve bytes");
}

#[tokio::test]
async fn an_upload_has_one_writer_at_a_time() {
    let folder = tempfile::tempdir().expect("a folder");
    // As two processes would.
    let [one, other] = [(); 2].map(|()| Blobs::open(folder.path()).expect("a store"));
    let id = UploadId(uuid::Uuid::from_u128(1));
    let writer = one.open_upload(id).await.expect("opens").expect("free");
    for blobs in [&one, &other] {
        assert!(blobs.open_upload(id).await.expect("asked").is_none());
    }
    let writing = tokio::spawn(async move {
        let _writer = writer;
        std::future::pending::<()>().await;
    });
    writing.abort();
    assert!(writing.await.expect_err("it died").is_cancelled());
    assert!(other.open_upload(id).await.expect("asked").is_some());
}
