//! Datasets that no training could use, sent to the real service: each is refused with the type of its fault, and leaves nothing behind.

use std::{
    collections::BTreeMap,
    fs,
    io::{Cursor, Write as _},
    path::Path,
};

use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use crate::support::{dataset, service::Service};

/// Files of a dataset by name.
type Files = BTreeMap<String, Vec<u8>>;

fn png(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image::RgbImage::new(width, height).write_to(&mut bytes, image::ImageFormat::Png).expect("encodes");
    bytes.into_inner()
}

/// Two images with a table in the layout of nerfstudio, and points.
fn transforms() -> Files {
    let frame = |index: u32| {
        format!(
            r#"{{"file_path": "{index}.png", "transform_matrix": [[1,0,0,{index}],[0,1,0,0.25],[0,0,1,4],[0,0,0,1]]}}"#
        )
    };
    let table = format!(
        r#"{{"fl_x": 9.0, "w": 8, "h": 6, "ply_file_path": "p.ply", "frames": [{}, {}]}}"#,
        frame(0),
        frame(1)
    );
    let points = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                  end_header\n1 2 3\n";
    [
        ("transforms.json", table.into_bytes()),
        ("p.ply", points.into()),
        ("0.png", png(8, 6)),
        ("1.png", png(8, 6)),
    ]
    .map(|(name, content)| (name.to_owned(), content))
    .into()
}

/// Two images with the text tables of COLMAP.
fn colmap() -> Files {
    [
        ("sparse/0/cameras.txt", b"1 PINHOLE 8 6 9 9.5 4.25 3\n".to_vec()),
        ("sparse/0/images.txt", b"1 1 0 0 0 0 0 4 1 0.png\n\n2 1 0 0 0 1 0 4 1 1.png\n\n".to_vec()),
        ("sparse/0/points3D.txt", b"1 1 2 3 10 20 30 0.1 1 0\n".to_vec()),
        ("images/0.png", png(8, 6)),
        ("images/1.png", png(8, 6)),
    ]
    .map(|(name, content)| (name.to_owned(), content))
    .into()
}

/// The files with the content of one replaced.
fn with(mut files: Files, name: &str, content: impl Into<Vec<u8>>) -> Vec<u8> {
    files.insert(name.to_owned(), content.into());
    zipped(&files)
}

/// The files with a word of one replaced.
fn edited(mut files: Files, name: &str, from: &str, to: &str) -> Vec<u8> {
    let content = files.get_mut(name).expect("a file");
    let text = String::from_utf8(content.clone()).expect("text");
    assert!(text.contains(from), "{text}");
    *content = text.replacen(from, to, 1).into_bytes();
    zipped(&files)
}

fn zipped(files: &Files) -> Vec<u8> {
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, content) in files {
        zip.start_file(name, options).expect("an entry");
        zip.write_all(content).expect("written");
    }
    zip.finish().expect("an archive").into_inner()
}

/// An archive with one entry changed in its directory and its own header alike: `from` becomes the equally long `to`.
fn patched(from: &[u8], to: &[u8]) -> Vec<u8> {
    let mut archive = zipped(&transforms());
    for at in 0..archive.len() - from.len() {
        if archive[at..].starts_with(from) {
            archive[at..at + from.len()].copy_from_slice(to);
        }
    }
    archive
}

/// An entry that unpacks to a thousand times its size, nested archives of it, and a link.
fn bomb() -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file("zeros.bin", SimpleFileOptions::default()).expect("an entry");
    zip.write_all(&vec![0; 16 << 20]).expect("written");
    zip.finish().expect("an archive").into_inner()
}

fn link() -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    zip.add_symlink("images", "/etc", SimpleFileOptions::default()).expect("a link");
    zip.finish().expect("an archive").into_inner()
}

/// A binary model of COLMAP that claims more cameras than any file holds.
fn claimed_cameras() -> Vec<u8> {
    let mut files = Files::new();
    for table in ["cameras", "images", "points3D"] {
        files.insert(format!("sparse/0/{table}.bin"), u64::MAX.to_le_bytes().to_vec());
    }
    zipped(&files)
}

fn two_datasets() -> Vec<u8> {
    let inside = |folder: &'static str| {
        transforms().into_iter().map(move |(name, content)| (format!("{folder}/{name}"), content))
    };
    zipped(&inside("a").chain(inside("b")).collect())
}

/// A PNG whose header claims a hundred thousand pixels per side.
fn endless_png() -> Vec<u8> {
    let mut image = png(8, 6);
    let side = 100_000_u32.to_be_bytes();
    image[16..24].copy_from_slice(&[side, side].concat());
    let mut checked = flate2::Crc::new();
    checked.update(&image[12..29]);
    image[29..33].copy_from_slice(&checked.sum().to_be_bytes());
    image
}

fn endless_image() -> Vec<u8> {
    with(transforms(), "0.png", endless_png())
}

/// What is sent, how it is answered (status, type, file) and a word of the reason.
type Row = (&'static str, Vec<u8>, u16, &'static str, &'static str, &'static str);

fn archives() -> Vec<Row> {
    let whole = zipped(&transforms());
    let cut = whole[..whole.len() / 2].to_vec();
    vec![
        ("no archive", b"hello".to_vec(), 400, "not-a-zip", "", "not a zip"),
        ("half an archive", cut, 422, "archive-rejected", "", "cut short"),
        ("a bomb", bomb(), 413, "dataset-too-large", "zeros.bin", "times its packed size"),
        (
            "a nested archive",
            with(Files::new(), "set.zip", whole),
            422,
            "dataset-rejected",
            "",
            "no dataset was found",
        ),
        ("an escape", patched(b"0.png", b"../pn"), 422, "archive-rejected", "../pn", "not safe"),
        ("a root", patched(b"0.png", b"/0png"), 422, "archive-rejected", "/0png", "not safe"),
        ("a drive", patched(b"0.png", b"C:png"), 422, "archive-rejected", "C:png", "drive letter"),
        (
            "a zero byte",
            patched(b"0.png", b"0\0png"),
            422,
            "archive-rejected",
            "0\u{fffd}png",
            "control characters",
        ),
        ("a name twice", patched(b"1.png", b"0.png"), 422, "archive-rejected", "0.png", "twice"),
        ("a link", link(), 422, "archive-rejected", "images", "symbolic link"),
    ]
}

fn tables() -> Vec<Row> {
    let json = |from, to| edited(transforms(), "transforms.json", from, to);
    let text = |table: &str, from, to| edited(colmap(), &format!("sparse/0/{table}.txt"), from, to);
    vec![
        (
            "no JSON",
            with(transforms(), "transforms.json", "{"),
            422,
            "table-rejected",
            "transforms.json",
            "EOF",
        ),
        (
            "a deep table",
            with(transforms(), "transforms.json", format!("{{\"other\": {}", "[".repeat(10_000))),
            422,
            "table-rejected",
            "transforms.json",
            "128 deep",
        ),
        (
            "a word for a number",
            json("9.0", "\"9\""),
            422,
            "table-rejected",
            "transforms.json",
            "invalid type",
        ),
        ("half a matrix", json("[0,0,1,4],", ""), 422, "camera-rejected", "transforms.json", "not rigid"),
        ("an endless pose", json("0.25", "1e999"), 422, "table-rejected", "transforms.json", "out of range"),
        (
            "a scaled pose",
            json("[0,1,0,0.25]", "[0,2,0,0.25]"),
            422,
            "camera-rejected",
            "transforms.json",
            "not rigid",
        ),
        ("no focal length", json("9.0", "0"), 422, "camera-rejected", "transforms.json", "focal length is 0"),
        ("a far camera", json("0.25", "1e300"), 422, "camera-rejected", "0.png", "outside of any real"),
        (
            "a missing image",
            json("1.png", "2.png"),
            422,
            "dataset-rejected",
            "transforms.json",
            "missing: 2.png",
        ),
        ("no image's path", json("1.png", "../.."), 422, "table-rejected", "transforms.json", "not safe"),
        (
            "an image outside",
            json("1.png", "../../etc/passwd"),
            422,
            "dataset-rejected",
            "transforms.json",
            "missing: ../../etc/passwd",
        ),
        ("two datasets", two_datasets(), 422, "dataset-rejected", "", "there are 2 datasets, in a/, b/"),
        (
            "claimed cameras",
            claimed_cameras(),
            422,
            "table-rejected",
            "sparse/0/cameras.bin",
            "claims 18446744073709551615",
        ),
        (
            "no quaternion",
            text("images", "1 1 0 0 0", "1 0 0 0 0"),
            422,
            "camera-rejected",
            "sparse/0/images.txt",
            "length 0",
        ),
        (
            "a pose of NaN",
            text("images", "1 1 0 0 0", "1 nan 0 0 0"),
            422,
            "camera-rejected",
            "sparse/0/images.txt",
            "non-finite",
        ),
        (
            "an unknown lens",
            text("cameras", "PINHOLE", "SPHERE"),
            422,
            "camera-rejected",
            "sparse/0/cameras.txt",
            "not supported",
        ),
        (
            "a panorama",
            text("cameras", "PINHOLE 8 6 9 9.5 4.25 3", "EQUIRECTANGULAR 8 6 8 6"),
            422,
            "camera-rejected",
            "sparse/0/cameras.txt",
            "perspective",
        ),
        (
            "a lens that folds",
            text("cameras", "PINHOLE 8 6 9 9.5 4.25 3", "OPENCV_FISHEYE 8 6 9 9.5 4.25 3 -1e300 0 0 0"),
            422,
            "camera-rejected",
            "images/0.png",
            "too strong",
        ),
        (
            "a lens of NaN",
            text("cameras", "PINHOLE 8 6 9 9.5 4.25 3", "FOV 8 6 9 9.5 4.25 3 nan"),
            422,
            "camera-rejected",
            "sparse/0/cameras.txt",
            "not finite",
        ),
        (
            "a point nowhere",
            text("points3D", "1 1 2 3", "1 inf 2 3"),
            422,
            "table-rejected",
            "sparse/0/points3D.txt",
            "not finite",
        ),
    ]
}

fn points_and_images() -> Vec<Row> {
    let ply = |from, to| edited(transforms(), "p.ply", from, to);
    let mut cut = png(8, 6);
    cut.truncate(20);
    vec![
        (
            "no point cloud",
            with(transforms(), "p.ply", "ply\n"),
            422,
            "points-rejected",
            "p.ply",
            "usable point cloud",
        ),
        (
            "claimed points",
            ply("vertex 1", "vertex 99999999999"),
            422,
            "points-rejected",
            "p.ply",
            "claims 99999999999",
        ),
        ("a point of NaN", ply("1 2 3", "1 nan 3"), 422, "points-rejected", "p.ply", "finite"),
        ("half a point", ply("property float z\n", ""), 422, "points-rejected", "p.ply", "lack x, y or z"),
        ("no image", with(transforms(), "1.png", "hello"), 422, "image-rejected", "1.png", "not a readable"),
        (
            "a TIFF",
            with(transforms(), "1.png", b"II*\0\x08\0\0\0".as_slice()),
            422,
            "image-rejected",
            "1.png",
            "mogrify -format png *.png",
        ),
        ("half a header", with(transforms(), "1.png", cut), 422, "image-rejected", "1.png", "not a readable"),
        (
            "another size",
            with(transforms(), "1.png", png(9, 6)),
            422,
            "image-rejected",
            "1.png",
            "9x6 pixels",
        ),
        ("on its side", with(transforms(), "1.png", png(6, 8)), 422, "image-rejected", "1.png", "90 degrees"),
        ("an endless image", endless_image(), 413, "dataset-too-large", "0.png", "more than 16384 pixels"),
    ]
}

fn masks() -> Vec<Row> {
    let stated =
        |mask: &str| edited(transforms(), "transforms.json", r#"{"fl_x""#, &format!("{{{mask}, \"fl_x\""));
    let many: Files = (0..5).map(|index| (format!("masks_{index}/0.png"), png(8, 6))).collect();
    vec![
        (
            "masks of nothing",
            with(transforms(), "masks/x.png", png(8, 6)),
            422,
            "dataset-rejected",
            "",
            "none of its images (1) has the name",
        ),
        (
            "a mask of another shape",
            with(transforms(), "masks/0.png", png(6, 8)),
            422,
            "dataset-rejected",
            "masks/0.png",
            "the mask has (6, 8) pixels",
        ),
        (
            "no mask",
            with(transforms(), "masks/0.png", "hello"),
            422,
            "image-rejected",
            "masks/0.png",
            "not a readable",
        ),
        (
            "an endless mask",
            with(transforms(), "masks/0.png", endless_png()),
            413,
            "dataset-too-large",
            "masks/0.png",
            "more than 16384 pixels",
        ),
        (
            "a mask that is missing",
            stated(r#""mask_path": "m.png""#),
            422,
            "dataset-rejected",
            "transforms.json",
            "the mask 'm.png' is missing",
        ),
        (
            "a mask elsewhere",
            stated(r#""mask_path": "../m.png""#),
            422,
            "table-rejected",
            "transforms.json",
            "'..' part",
        ),
        (
            "masks in a list",
            stated(r#""masks": ["0.png"]"#),
            422,
            "dataset-rejected",
            "transforms.json",
            "not by the path of one image",
        ),
        (
            "too many masks",
            zipped(&transforms().into_iter().chain(many).collect()),
            422,
            "dataset-rejected",
            "masks_4/0.png",
            "one mask too many",
        ),
    ]
}

/// Photographs and videos that no file says the cameras of.
fn without_cameras() -> Vec<Row> {
    let photographs =
        || -> Files { ["a.png", "b.png", "c.png"].map(|name| (name.to_owned(), png(8, 6))).into() };
    let video = |content: &[u8]| with(Files::new(), "v.mp4", content);
    let two: Files = ["v.mp4", "w.mov"].map(|name| (name.to_owned(), b"\0\0\0\x14ftypisom".to_vec())).into();
    let mut few = photographs();
    few.remove("b.png");
    vec![
        ("two photographs", zipped(&few), 422, "too-few-photographs", "", "there are 2 photographs"),
        (
            "no photograph",
            with(photographs(), "c.png", "hello"),
            422,
            "image-rejected",
            "c.png",
            "not a readable",
        ),
        (
            "an endless photograph",
            with(photographs(), "c.png", endless_png()),
            413,
            "dataset-too-large",
            "c.png",
            "more than 16384 pixels",
        ),
        (
            "a photograph of a telephone",
            with(photographs(), "d.heic", "hello"),
            422,
            "image-rejected",
            "d.heic",
            "mogrify",
        ),
        ("no video", video(b"<html><body>"), 422, "dataset-rejected", "v.mp4", "not an MP4"),
        ("half a video's name", video(b"\0\0\0\x14fty"), 422, "dataset-rejected", "v.mp4", "not an MP4"),
        ("two videos", zipped(&two), 422, "dataset-rejected", "w.mov", "second video"),
    ]
}

/// Files in folders of `data` that hold content: blobs, uploads, and what is staged.
fn kept(data: &Path) -> Vec<String> {
    let mut found = Vec::new();
    let mut folders: Vec<_> = ["blobs", "uploads", "staging"].iter().map(|name| data.join(name)).collect();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).into_iter().flatten() {
            let path = entry.expect("an entry").path();
            match path.is_dir() {
                true => folders.push(path),
                // The lock of a process on its staging folder.
                false if path.file_name().is_some_and(|name| name == "held") => {}
                false => found.push(path.strip_prefix(data).expect("below").display().to_string()),
            }
        }
    }
    found.sort();
    found
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_kind_of_unusable_dataset_is_refused_by_its_type_and_leaves_nothing() {
    let data = tempfile::tempdir().expect("a folder");
    let service = Service::start_with(data.path(), ["--workers", "0"]).await;
    // What the rows change is accepted as it is.
    for files in [transforms(), colmap()] {
        service.upload("", zipped(&files)).await.expect(201);
    }
    let lists = ["/v1/jobs", "/v1/scenes", "/v1/usage"];
    let mut before = Vec::new();
    for list in lists {
        before.push(service.get(list).await.expect(200).json());
    }
    let accepted = kept(data.path());
    let mut wrong = Vec::new();
    for (what, archive, status, kind, file, words) in archives()
        .into_iter()
        .chain(tables())
        .chain(points_and_images())
        .chain(masks())
        .chain(without_cameras())
    {
        for path in ["/v1/jobs", "/v1/scenes"] {
            let answer = service
                .send("POST", path, |request| {
                    request.header("content-type", "application/zip").body(archive.clone())
                })
                .await;
            let body = answer.json();
            let told = (answer.status, body["type"].as_str(), body["file"].as_str().unwrap_or_default());
            let detail = body["detail"].as_str().unwrap_or_default();
            let private = body.to_string().contains(&*data.path().to_string_lossy());
            if told != (status, Some(&*format!("urn:tcgs:problem:{kind}")), file)
                || !detail.contains(words)
                || private
                || kept(data.path()) != accepted
            {
                wrong
                    .push(format!("{what}, which should say {status} {kind} '{words}': {told:?} '{detail}'"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    for (list, before) in lists.into_iter().zip(before) {
        assert_eq!(service.get(list).await.expect(200).json(), before, "{list}");
    }
    service.upload("", dataset::zip()).await.expect(201);
    service.stop().await;
}
