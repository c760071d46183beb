//! What is fuzzed of the readers of uploads, requests and other programs' files. Each function takes any bytes and panics where
//! something is accepted that breaks an invariant, or refused as anything but the sender's error; a test of the project runs them on the
//! committed corpus with the ordinary compiler.

use std::{
    fs,
    io::{Cursor, Write as _},
    path::Path,
};

use flate2::{Compression, write::GzEncoder};
use tcgs::{
    domain::{Camera, Dataset, GaussianScene, NamedCamera, Split},
    export,
    http::parsers,
    ingest::{self, LoadBudget},
};
use tempfile::TempDir;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

/// Eight by six pixels.
pub(super) const PNG: [u8; 74] = [
    137, 80, 78, 71, 13, 10, 26, 10, 0, 0, 0, 13, 73, 72, 68, 82, 0, 0, 0, 8, 0, 0, 0, 6, 8, 2, 0, 0, 0, 113,
    103, 72, 172, 0, 0, 0, 17, 73, 68, 65, 84, 120, 218, 99, 56, 145, 98, 132, 21, 49, 12, 164, 4, 0, 87,
    179, 65, 161, 204, 7, 255, 41, 0, 0, 0, 0, 73, 69, 78, 68, 174, 66, 96, 130,
];

/// Larger sets are only checked, so that an input cannot make a run slow by being allowed to be large.
const MAX_PIXELS: u64 = 1 << 20;

/// Memory for pixels; the rest goes to disk.
const MEMORY: u64 = 1 << 20;

/// Photographs beside which masks are put, and most names of masks.
const MASKED: [&str; 3] = ["images/0.png", "images/left/1.png", "images/right/1.png"];
const MAX_MASKS: usize = 64;

/// Files of a set in COLMAP's layout, in the order of an input's parts.
const TABLES: [&str; 3] = ["cameras", "images", "points3D"];

/// `data` as an archive as it is, and as the description of one.
pub(super) fn ingest_zip(data: &[u8]) {
    let folder = folder();
    for bytes in [data.to_vec(), archive(&mut Bytes(data))] {
        let path = folder.path().join("set.zip");
        fs::write(&path, bytes).expect("the temporary folder is writable");
        dataset(&path);
    }
}

/// `data` as the three binary tables: two lengths of 16 bits, then the tables.
pub(super) fn colmap_binary(data: &[u8]) {
    let mut bytes = Bytes(data);
    let lengths = [bytes.u16(), bytes.u16()];
    let [cameras, images] = lengths.map(|length| bytes.take(length).to_vec());
    colmap("bin", [&cameras, &images, bytes.0]);
}

/// `data` as the three text tables, with a zero byte between.
pub(super) fn colmap_text(data: &[u8]) {
    let mut parts = data.splitn(3, |byte| *byte == 0);
    colmap("txt", [(); 3].map(|()| parts.next().unwrap_or_default()));
}

/// `data` as a camera: a byte for COLMAP's number of the model, then its parameters. As binary tables, and as fields of a transforms file.
pub(super) fn camera(data: &[u8]) {
    let mut bytes = Bytes(data);
    let model = u32::from(bytes.u8() % 20);
    let numbers: Vec<f64> = (0..16).map(|_| bytes.f64()).collect();
    // A model takes as many parameters as it has; what is left of the table is refused, so every count is tried.
    for count in [3, 4, 5, 6, 8, 12, 16] {
        let mut cameras = 1_u64.to_le_bytes().to_vec();
        for part in
            [&1_u32.to_le_bytes()[..], &model.to_le_bytes(), &8_u64.to_le_bytes(), &6_u64.to_le_bytes()]
        {
            cameras.extend(part);
        }
        cameras.extend(numbers[..count].iter().flat_map(|number| number.to_le_bytes()));
        let mut images = 2_u64.to_le_bytes().to_vec();
        for (id, name) in [(1_u32, b"0.png\0"), (2, b"1.png\0")] {
            images.extend(id.to_le_bytes());
            let pose = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, f64::from(id)];
            images.extend(pose.iter().flat_map(|number: &f64| number.to_le_bytes()));
            images.extend(1_u32.to_le_bytes());
            images.extend(name);
            images.extend(0_u64.to_le_bytes());
        }
        colmap("bin", [&cameras, &images, &0_u64.to_le_bytes()]);
    }
    let finite = |number: &f64| if number.is_finite() { format!("{number:e}") } else { "0".to_owned() };
    let numbers: Vec<String> = numbers.iter().map(finite).collect();
    let name = ["OPENCV_FISHEYE", "FISHEYE624", "FULL_OPENCV", "OPENCV"][model as usize % 4];
    let [k1, k2, p1, p2, k3, k4, k5, k6] = [4, 5, 6, 7, 8, 9, 10, 11].map(|index| &numbers[index]);
    let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
    let table = format!(
        r#"{{"camera_model": "{name}", "fl_x": {}, "fl_y": {}, "cx": {}, "cy": {}, "k1": {k1}, "k2": {k2}, "k3": {k3}, "k4": {k4},
            "k5": {k5}, "k6": {k6}, "p1": {p1}, "p2": {p2}, "distortion_params": [{}], "frames": [
            {{"file_path": "images/0.png", "transform_matrix": {pose}}}, {{"file_path": "images/1.png", "transform_matrix": {pose}}}]}}"#,
        numbers[0],
        numbers[1],
        numbers[2],
        numbers[3],
        numbers[4..].join(","),
    );
    transforms_json(table.as_bytes());
}

/// `data` as `transforms.json`, and as a Blender set's list of training views.
pub(super) fn transforms_json(data: &[u8]) {
    for name in ["transforms.json", "transforms_train.json"] {
        let folder = folder();
        write(folder.path(), name, data);
        for image in ["images/0.png", "images/1.png", "train/r_0.png", "train/r_1.png"] {
            write(folder.path(), image, &PNG);
        }
        dataset(folder.path());
    }
}

/// `data` as masks: their names, a line each, up to a zero byte, then the content of all of them.
pub(super) fn masks(data: &[u8]) {
    let end = data.iter().position(|byte| *byte == 0);
    let (names, content) = end.map_or((data, &PNG[..]), |end| (&data[..end], &data[end + 1..]));
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let mut put = |name: &str, content: &[u8]| {
        let options = SimpleFileOptions::default();
        // A name may be there already, or be none that an archive can have.
        if zip.start_file(name, options).is_ok() {
            zip.write_all(content).expect("memory is writable");
        }
    };
    let frames: Vec<String> = MASKED
        .iter()
        .map(|image| {
            format!(r#"{{"file_path":"{image}","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,4]]}}"#)
        })
        .collect();
    let table = format!(r#"{{"fl_x":9,"w":8,"h":6,"k1":-0.01,"frames":[{}]}}"#, frames.join(","));
    put("transforms.json", table.as_bytes());
    MASKED.iter().for_each(|image| put(image, &PNG));
    for name in String::from_utf8_lossy(names).lines().take(MAX_MASKS) {
        put(name, content);
    }
    let folder = folder();
    let path = folder.path().join("set.zip");
    let archive = zip.finish().expect("memory is writable").into_inner();
    fs::write(&path, archive).expect("the temporary folder is writable");
    dataset(&path);
}

/// `data` as a file of Gaussians, and as the points of a set.
pub(super) fn ply(data: &[u8]) {
    if let Ok(scene) = export::from_ply(data) {
        assert_eq!(scene.check(), Ok(()));
        let again = export::from_ply(&export::to_ply(&scene)).expect("what was written is read");
        assert_eq!(again, scene);
    }
    let folder = folder();
    write(
        folder.path(),
        "transforms.json",
        br#"{"w": 8, "h": 6, "fl_x": 9, "ply_file_path": "points.ply", "frames": [
            {"file_path": "images/0.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},
            {"file_path": "images/1.png", "transform_matrix": [[1,0,0,1],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"#,
    );
    write(folder.path(), "points.ply", data);
    write(folder.path(), "images/0.png", &PNG);
    write(folder.path(), "images/1.png", &PNG);
    dataset(folder.path());
}

/// `data` as a `.spz` file, and as what the gzip stream of one holds.
pub(super) fn spz(data: &[u8]) {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(data).expect("memory is writable");
    for bytes in [data, &gzip.finish().expect("memory is writable")] {
        if let Ok(scene) = export::from_spz(bytes) {
            assert_eq!(scene.check(), Ok(()));
            written_again(&scene);
        }
    }
}

/// `data` as the query of a view.
pub(super) fn view_query(data: &[u8]) {
    let query = std::str::from_utf8(data).ok();
    match parsers::view_query(query, &[]) {
        Ok(camera) => sound(&camera),
        Err(problem) => assert!((400..500).contains(&problem.status), "{problem:?}"),
    }
    let Ok(camera) = parsers::view_query(Some("position=3,0,0&look_at=0,0,0&width=8&height=6"), &[]) else {
        panic!("a usual view is refused");
    };
    let named = NamedCamera { name: "images/0.png".to_owned(), split: Split::Train, camera };
    if let Ok(camera) = parsers::view_query(query, &[named]) {
        sound(&camera);
    }
}

/// `data` as the headers of a request, a line each, then after an empty line as its body.
pub(super) fn upload_headers(data: &[u8]) {
    let end = data.windows(2).position(|pair| pair == b"\n\n");
    let (head, body) = end.map_or((data, &[][..]), |end| (&data[..end], &data[end + 2..]));
    let headers: Vec<(&[u8], &[u8])> = head
        .split(|byte| *byte == b'\n')
        .filter_map(|line| {
            let colon = line.iter().position(|byte| *byte == b':')?;
            Some((line[..colon].trim_ascii(), line[colon + 1..].trim_ascii()))
        })
        .collect();
    let headers = parsers::headers(&headers);
    match parsers::create_upload(&headers) {
        Ok((_, metadata)) => assert!(metadata.is_none_or(|text| text.len() <= 4096)),
        Err(problem) => assert!((400..500).contains(&problem.status), "{problem:?}"),
    }
    if let Err(problem) = parsers::append_part(&headers, body) {
        assert!((400..500).contains(&problem.status), "{problem:?}");
    }
}

/// What must hold of any dataset.
fn dataset(path: &Path) {
    let budget = LoadBudget { memory_bytes: MEMORY, spill_dir: std::env::temp_dir() };
    match ingest::check(path) {
        Err(problem) => {
            assert!(matches!(problem.status, 400 | 413 | 422), "{problem:?}");
            let refused = ingest::load_with_budget(path, &budget).expect_err("what is refused is not loaded");
            assert_eq!(refused.kind, problem.kind, "{refused:?}");
        }
        Ok(summary) if summary.pixels > MAX_PIXELS => {}
        Ok(summary) => match ingest::load_with_budget(path, &budget) {
            // Pixels are decoded now.
            Err(problem) => assert!(matches!(problem.status, 413 | 422 | 507), "{problem:?}"),
            Ok(loaded) => {
                let of = |split| loaded.split(split).count();
                // What masks hide as a whole is left out, once pixels are decoded.
                let hidden = loaded.notes.iter().any(|note| note.contains("hide every pixel"));
                let (train, test) = (of(Split::Train), of(Split::Test));
                assert!(hidden || (train, test) == (summary.train, summary.test));
                assert!(train <= summary.train && test <= summary.test);
                let points = loaded.points.as_ref().map(|points| points.positions.len());
                assert_eq!((loaded.layout, points), (summary.layout, summary.points));
                loaded_soundly(&loaded);
            }
        },
    }
}

/// The invariants of `tcgs::domain::dataset`.
fn loaded_soundly(dataset: &Dataset) {
    assert!(dataset.split(Split::Train).next().is_some());
    let mut names: Vec<&str> = dataset.frames.iter().map(|frame| frame.name.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), dataset.frames.len(), "names are unique");
    for frame in &dataset.frames {
        sound(&frame.camera);
        let size = [frame.camera.intrinsics.width, frame.camera.intrinsics.height];
        let image = frame.image.load().expect("pixels are there");
        assert_eq!([image.width(), image.height()], size);
        assert!(frame.mask.as_ref().is_none_or(|mask| [mask.width(), mask.height()] == size));
    }
    if let Some(points) = &dataset.points {
        assert_eq!(points.positions.len(), points.colors.len());
        assert!(points.positions.iter().flatten().all(|value| value.is_finite()));
    }
}

fn sound(camera: &Camera) {
    let k = &camera.intrinsics;
    assert!(
        [k.fx, k.fy, k.cx, k.cy].iter().all(|value| value.is_finite()) && k.fx > 0.0 && k.fy > 0.0,
        "{k:?}"
    );
    assert!(k.width > 0 && k.height > 0, "{k:?}");
    assert!(camera.pose.center().is_finite(), "{camera:?}");
}

/// A scene that was read is read again from what is written of it, if it can be written.
fn written_again(scene: &GaussianScene) {
    if let Ok(packed) = export::to_spz(scene, export::SpzVersion::V4) {
        let again = export::from_spz(&packed.bytes).expect("what was written is read");
        assert_eq!((again.len(), again.check()), (packed.gaussians, Ok(())));
    }
}

fn colmap(extension: &str, tables: [&[u8]; 3]) {
    let folder = folder();
    for (name, table) in TABLES.iter().zip(tables) {
        write(folder.path(), &format!("sparse/0/{name}.{extension}"), table);
    }
    for image in ["images/0.png", "images/1.png"] {
        write(folder.path(), image, &PNG);
    }
    dataset(folder.path());
}

fn folder() -> TempDir {
    let memory = Path::new("/dev/shm");
    let made = if memory.is_dir() { TempDir::new_in(memory) } else { TempDir::new() };
    made.expect("there is a temporary folder")
}

fn write(folder: &Path, name: &str, content: &[u8]) {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().expect("a name in the folder"))
        .expect("the temporary folder is writable");
    fs::write(path, content).expect("the temporary folder is writable");
}

/// Entries of archives that are described.
const ENTRIES: [(&str, &[u8]); 7] = [
    (
        "transforms.json",
        br#"{"camera_angle_x": 0.8, "frames": [
            {"file_path": "images/0.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},
            {"file_path": "images/1.png", "transform_matrix": [[1,0,0,1],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"#,
    ),
    ("images/0.png", &PNG),
    ("images/1.png", &PNG),
    ("sparse/0/cameras.txt", b"1 PINHOLE 8 6 9 9.5 4.25 3\n"),
    ("sparse/0/images.txt", b"1 1 0 0 0 0.5 0.25 4 1 0.png\n1 2 -1\n2 1 0 0 0 0.5 0.5 4 1 1.png\n\n"),
    ("sparse/0/points3D.txt", b"1 1 2 3 10 20 30 0.1 1 0\n"),
    ("points.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"),
];

/// An archive of usual entries, changed ones and others, with a few bytes of it changed at the end.
fn archive(bytes: &mut Bytes<'_>) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for _ in 0..bytes.u8() % 12 {
        let head = usize::from(bytes.u8());
        let (name, usual) = match ENTRIES.get(head % 8) {
            Some((name, content)) => ((*name).to_owned(), *content),
            None => (text(bytes), &[][..]),
        };
        let content = match head / 8 % 4 {
            0 | 1 => usual.to_vec(),
            2 => text(bytes).into_bytes(),
            _ => vec![0; 512 * usize::from(bytes.u8())],
        };
        let method = if head & 32 == 0 { CompressionMethod::Stored } else { CompressionMethod::Deflated };
        let options = SimpleFileOptions::default().compression_method(method).large_file(head & 64 != 0);
        // Names that the writer refuses are left out.
        if zip.start_file(name, options).is_ok() {
            zip.write_all(&content).expect("memory is writable");
        }
    }
    let mut archive = zip.finish().map(Cursor::into_inner).unwrap_or_default();
    for _ in 0..bytes.u8() % 8 {
        let place = bytes.u16().checked_rem(archive.len());
        if let Some(place) = place {
            archive[place] ^= bytes.u8();
        }
    }
    archive
}

/// A length and so many bytes, as text.
fn text(bytes: &mut Bytes<'_>) -> String {
    let length = usize::from(bytes.u8());
    String::from_utf8_lossy(bytes.take(length)).into_owned()
}

/// Reads numbers off the front; zeros after the end.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn u8(&mut self) -> u8 {
        self.take(1).first().copied().unwrap_or(0)
    }

    fn u16(&mut self) -> usize {
        usize::from(self.u8()) + 256 * usize::from(self.u8())
    }

    fn f64(&mut self) -> f64 {
        let mut number = [0; 8];
        let taken = self.take(8);
        number[..taken.len()].copy_from_slice(taken);
        f64::from_le_bytes(number)
    }

    fn take(&mut self, count: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(count.min(self.0.len()));
        self.0 = rest;
        taken
    }
}
