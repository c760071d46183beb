//! Uploads that ask for far more memory than they are long, sent to the real service, whose memory is watched meanwhile.

use std::{
    fs,
    io::{Cursor, Write as _},
    path::Path,
};

use image::{DynamicImage, ImageFormat, RgbImage};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use crate::support::{dataset, server::Answer, service::Service};

/// What one upload may add to the memory of the service.
const BOUND: u64 = 128 << 20;

/// Datasets that the service checks at a time.
const TOGETHER: u64 = 2;

/// Longest run of bytes between those that cannot be compressed: without them no entry would pass for its ratio.
const BLOCK: usize = 64 << 10;

/// A zip in the making.
struct Archive {
    zip: ZipWriter<Cursor<Vec<u8>>>,
    random: Pcg64Mcg,
}

impl Archive {
    fn new() -> Self {
        Self { zip: ZipWriter::new(Cursor::new(Vec::new())), random: Pcg64Mcg::seed_from_u64(5) }
    }

    fn with(mut self, name: &str, content: &[u8]) -> Self {
        self.start(name);
        self.write(content);
        self
    }

    fn start(&mut self, name: &str) {
        let fast = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Deflated)
            .compression_level(Some(1));
        self.zip.start_file(name, fast).expect("an entry");
    }

    fn write(&mut self, content: &[u8]) {
        self.zip.write_all(content).expect("in memory");
    }

    /// As many blocks as come to `bytes`, each made by `block` with some bytes that cannot be compressed.
    fn fill(&mut self, bytes: usize, block: impl Fn(&[u8; 512]) -> Vec<u8>) {
        let mut noise = [0; 512];
        let mut written = 0;
        while written < bytes {
            self.random.fill(&mut noise[..]);
            let block = block(&noise);
            self.write(&block);
            written += block.len();
        }
    }

    fn finish(self) -> Vec<u8> {
        self.zip.finish().expect("in memory").into_inner()
    }
}

fn png() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    DynamicImage::from(RgbImage::new(8, 6)).write_to(&mut bytes, ImageFormat::Png).expect("encodes");
    bytes.into_inner()
}

fn letters(noise: &[u8]) -> String {
    noise.iter().map(|byte| format!("{byte:02x}")).collect()
}

const FRAME: &str = r#"{"file_path": "a.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}"#;

/// A dataset of one image whose table has `more` in it, between its brackets and `end`.
fn with_json(start: &str, bytes: usize, block: impl Fn(&[u8; 512]) -> Vec<u8>, end: &str) -> Vec<u8> {
    let mut archive = Archive::new().with("a.png", &png());
    archive.start("transforms.json");
    archive.write(start.as_bytes());
    archive.fill(bytes, block);
    archive.write(end.as_bytes());
    archive.finish()
}

fn empty_arrays() -> Vec<u8> {
    let block =
        |noise: &[u8; 512]| format!("{}\"{}\",", "[],".repeat(BLOCK / 3), letters(noise)).into_bytes();
    with_json(r#"{"x": ["#, 14 << 20, block, &format!(r#"0], "fl_x": 9, "frames": [{FRAME}]}}"#))
}

fn empty_frames() -> Vec<u8> {
    let frame = r#"{"file_path":"","transform_matrix":[]},"#;
    let noisy = |noise: &[u8; 512]| {
        let named = format!(r#"{{"file_path":"{}","transform_matrix":[]}},"#, letters(noise));
        [frame.repeat(BLOCK / frame.len()), named].concat().into_bytes()
    };
    with_json(r#"{"fl_x": 9, "frames": ["#, 14 << 20, noisy, &format!("{FRAME}]}}"))
}

fn rows_of_nothing() -> Vec<u8> {
    let block = |noise: &[u8; 512]| {
        let digits: String = noise.iter().map(|byte| format!("[{byte}],")).collect();
        ["[],".repeat(BLOCK / 3), digits].concat().into_bytes()
    };
    let start = r#"{"fl_x": 9, "frames": [{"file_path": "a.png", "transform_matrix": ["#;
    with_json(start, 14 << 20, block, "[]]}]}")
}

fn empty_names() -> Vec<u8> {
    let block =
        |noise: &[u8; 512]| format!("{}\"{}\",", "\"\",".repeat(BLOCK / 3), letters(noise)).into_bytes();
    with_json(&format!(r#"{{"fl_x": 9, "frames": [{FRAME}], "test_filenames": ["#), 14 << 20, block, "\"\"]}")
}

fn long_key() -> Vec<u8> {
    let block = |noise: &[u8; 512]| [&[b'a'; BLOCK][..], letters(noise).as_bytes()].concat();
    with_json("{\"", 14 << 20, block, "\": 1}")
}

fn deep_nesting() -> Vec<u8> {
    let block = |noise: &[u8; 512]| {
        let digits: String = noise.iter().map(|byte| format!("{byte},[")).collect();
        ["[".repeat(BLOCK), digits].concat().into_bytes()
    };
    with_json(r#"{"x": "#, 14 << 20, block, "")
}

fn jpegs_of_metadata() -> Vec<u8> {
    let segment = |noise: &[u8; 512]| [&[0xff, 0xe1, 0xff, 0xff][..], &[0; 0xfffd - 512], noise].concat();
    let frame = |name: &str| FRAME.replace("a.png", name);
    let table = format!(r#"{{"fl_x": 9, "frames": [{}, {}]}}"#, frame("a.jpg"), frame("b.jpg"));
    let mut archive = Archive::new().with("transforms.json", table.as_bytes());
    for name in ["a.jpg", "b.jpg"] {
        archive.start(name);
        archive.write(&[0xff, 0xd8]);
        archive.fill(150 << 20, segment);
    }
    archive.finish()
}

/// An archive of `count` empty files of which each has a name of `name` characters and `extra` in its central header.
fn empty_files(count: u32, name: usize, extra: &[u8], with_local_headers: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    let names = (0..count).map(|index| format!("{index:0name$}"));
    let lengths = [(name as u16).to_le_bytes(), (extra.len() as u16).to_le_bytes()].concat();
    let mut directory = Vec::new();
    for name in names {
        let at = bytes.len() as u32;
        if with_local_headers {
            bytes.extend(b"PK\x03\x04\x0a\0\0\0\0\0\0\0\0\0");
            bytes.extend([0; 12]);
            bytes.extend([&lengths[..2], &[0, 0]].concat());
            bytes.extend(name.as_bytes());
        }
        directory.extend(b"PK\x01\x02\x0a\0\x0a\0\0\0\0\0\0\0\0\0");
        directory.extend([0; 12]);
        directory.extend(&lengths);
        directory.extend([0; 10]);
        directory.extend(at.to_le_bytes());
        directory.extend(name.as_bytes());
        directory.extend(extra);
    }
    let (at, size) = (bytes.len() as u64, directory.len() as u64);
    bytes.append(&mut directory);
    let end = bytes.len() as u64;
    bytes.extend(b"PK\x06\x06");
    bytes.extend(44_u64.to_le_bytes());
    bytes.extend([45, 0, 45, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    for value in [u64::from(count), u64::from(count), size, at] {
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend(b"PK\x06\x07\0\0\0\0");
    bytes.extend(end.to_le_bytes());
    bytes.extend([1, 0, 0, 0]);
    bytes.extend(b"PK\x05\x06\0\0\0\0");
    bytes.extend([0xff; 12]);
    bytes.extend([0, 0]);
    bytes
}

/// A COLMAP set of one image; one of its tables is `table`, begun by `start` and filled with blocks.
fn colmap(table: &str, start: &[u8], bytes: usize, block: impl Fn(&[u8; 512]) -> Vec<u8>) -> Vec<u8> {
    let mut archive = Archive::new().with("images/a.png", &png());
    let image = "1 1 0 0 0 0 0 0 1 a.png\n\n";
    for (name, content) in [
        ("cameras.txt", "1 SIMPLE_PINHOLE 8 6 9 4 3\n"),
        ("images.txt", image),
        ("points3D.txt", "1 1 2 3 4 5 6 0.5\n"),
    ] {
        if name != table {
            archive = archive.with(&format!("sparse/0/{name}"), content.as_bytes());
        }
    }
    archive.start(&format!("sparse/0/{table}"));
    archive.write(start);
    archive.fill(bytes, block);
    archive.finish()
}

/// Triples of numbers in one line.
fn triples(word: &'static str) -> impl Fn(&[u8; 512]) -> Vec<u8> {
    move |noise| {
        let numbers: String = noise[..510].iter().map(|byte| format!(" {byte}")).collect();
        [word.repeat(BLOCK / word.len()), numbers].concat().into_bytes()
    }
}

fn points_of_a_binary_model() -> Vec<u8> {
    const RECORD: usize = 51;
    let records = BLOCK / RECORD;
    let bytes = 140 << 20;
    let blocks = (bytes as usize).div_ceil(records * RECORD);
    let count = (blocks * records) as u64;
    let mut archive = Archive::new().with("images/a.png", &png());
    let camera: Vec<u8> =
        [&1_u64.to_le_bytes()[..], &[1, 0, 0, 0, 0, 0, 0, 0], &8_u64.to_le_bytes(), &6_u64.to_le_bytes()]
            .into_iter()
            .flatten()
            .copied()
            .chain([9.0_f64, 4.0, 3.0].into_iter().flat_map(f64::to_le_bytes))
            .collect();
    let image: Vec<u8> = [&1_u64.to_le_bytes()[..], &[1, 0, 0, 0]]
        .into_iter()
        .flatten()
        .copied()
        .chain([1.0_f64, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0].into_iter().flat_map(f64::to_le_bytes))
        .chain([1, 0, 0, 0])
        .chain(*b"a.png\0")
        .chain([0; 8])
        .collect();
    archive = archive.with("sparse/0/cameras.bin", &camera).with("sparse/0/images.bin", &image);
    archive.start("sparse/0/points3D.bin");
    archive.write(&count.to_le_bytes());
    archive.fill(blocks * records * RECORD, |noise| {
        let mut block = vec![0; records * RECORD];
        // Ids and colors are free: they hold what cannot be compressed.
        for (record, part) in block.chunks_exact_mut(RECORD).zip(noise.chunks_exact(8)) {
            record[..8].copy_from_slice(part);
        }
        block
    });
    archive.finish()
}

fn header_of_a_point_cloud() -> Vec<u8> {
    let table = format!(r#"{{"fl_x": 9, "ply_file_path": "p.ply", "frames": [{FRAME}]}}"#);
    let mut archive = Archive::new().with("a.png", &png()).with("transforms.json", table.as_bytes());
    archive.start("p.ply");
    archive.write(b"ply\nformat ascii 1.0\n");
    archive.fill(140 << 20, |noise| {
        [&b"comment "[..], &[b'a'; BLOCK], letters(noise).as_bytes(), b"\n"].concat()
    });
    archive.finish()
}

/// PNG files whose color profile unpacks to 200 MiB.
fn profiles() -> Vec<u8> {
    let mut packed = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    for _ in 0..200 {
        packed.write_all(&vec![0; 1 << 20]).expect("in memory");
    }
    let profile = [&b"iCCPa\0\0"[..], &packed.finish().expect("in memory")].concat();
    let mut sum = flate2::Crc::new();
    sum.update(&profile);
    let plain = png();
    let (head, rest) = plain.split_at(33);
    let length = (profile.len() as u32 - 4).to_be_bytes();
    let image = [head, &length, &profile, &sum.sum().to_be_bytes(), rest].concat();
    let table = format!(r#"{{"fl_x": 9, "frames": [{FRAME}]}}"#);
    let mut noise = vec![0; image.len() / 100];
    Pcg64Mcg::seed_from_u64(1).fill(&mut noise[..]);
    let padded = [image, noise].concat();
    Archive::new().with("transforms.json", table.as_bytes()).with("a.png", &padded).finish()
}

/// Bytes of memory of a process: what it has now, and the most since it was last asked.
struct Memory {
    status: String,
    pid: u32,
}

impl Memory {
    fn of(pid: u32) -> Self {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).expect("a running process");
        Self { status, pid }
    }

    fn field(&self, name: &str) -> u64 {
        let line = self.status.lines().find_map(|line| line.strip_prefix(name)).expect(name);
        line.trim_start_matches(':').trim().trim_end_matches("kB").trim().parse::<u64>().expect("a number")
            << 10
    }

    fn now(&self) -> u64 {
        self.field("VmRSS")
    }

    /// The most since [`Memory::forget`].
    fn most(&self) -> u64 {
        self.field("VmHWM")
    }

    fn forget(&self) {
        fs::write(format!("/proc/{}/clear_refs", self.pid), "5").expect("the peak is set back");
    }
}

fn assert_answer(what: &str, answer: &Answer, statuses: &[u16], words: &str, data: &Path) {
    let body = String::from_utf8_lossy(&answer.body);
    assert!(statuses.contains(&answer.status), "{what}: {} {body}", answer.status);
    assert!(body.contains(words), "{what}: '{body}' should say '{words}'");
    assert!(!body.contains(&*data.to_string_lossy()), "{what}: {body} names the server's folder");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_upload_takes_more_than_128_mib_of_the_service() {
    let data = tempfile::tempdir().expect("a folder");
    let service = Service::start_with(data.path(), ["--workers", "0"]).await;
    service.upload("", dataset::zip()).await.expect(201);
    type Upload = fn() -> Vec<u8>;
    let uploads: [(&str, Upload, u16, &str); 14] = [
        ("a field of empty arrays", empty_arrays, 201, ""),
        ("empty frames", empty_frames, 422, "lists more than 20000 frames"),
        ("rows of nothing", rows_of_nothing, 422, "/frames/0/transform_matrix: must be a matrix"),
        ("empty names", empty_names, 422, "lists more than 20000 file names"),
        ("a long key", long_key, 422, "a string is longer than"),
        ("deep nesting", deep_nesting, 422, "more than 128 deep"),
        ("JPEG files of metadata", jpegs_of_metadata, 422, "header ends within its first 1048576 bytes"),
        ("a million entries", || empty_files(1_000_000, 7, &[], false), 413, "more than 100000 entries"),
        ("the most entries", || empty_files(95_000, 18, &[], true), 422, "no dataset was found"),
        (
            "entries of extra fields",
            || empty_files(95, 4, &[0xfe, 0xca, 0, 0].repeat(16_000), true),
            422,
            "no dataset was found",
        ),
        ("a binary model's points", points_of_a_binary_model, 201, ""),
        (
            "a text model's track",
            || colmap("points3D.txt", b"1 1 2 3 4 5 6 0.5", 140 << 20, triples(" 1 2 3")),
            201,
            "",
        ),
        ("a point cloud's header", header_of_a_point_cloud, 422, "no end_header"),
        ("a color profile", profiles, 0, ""),
    ];
    let pid = service.pid();
    for (what, upload, status, words) in uploads {
        let archive = upload();
        let sent = archive.len();
        Memory::of(pid).forget();
        let before = Memory::of(pid).now();
        let answer = service.upload("", archive).await;
        let most = Memory::of(pid).most();
        println!("{what}: {} KiB sent, {} KiB taken", sent >> 10, most.saturating_sub(before) >> 10);
        let statuses = if status == 0 { vec![201, 422] } else { vec![status] };
        assert_answer(what, &answer, &statuses, words, data.path());
        assert!(most < before + BOUND, "{what}: {before} bytes before, {most} at most");
    }

    // All together: as many as are received at a time, of the kind that takes the most.
    let archive = empty_files(95, 4, &[0xfe, 0xca, 0, 0].repeat(16_000), true);
    Memory::of(pid).forget();
    let before = Memory::of(pid).now();
    let answers = futures_util::future::join_all((0..6).map(|_| service.upload("", archive.clone()))).await;
    for answer in &answers {
        assert_answer("one of six", answer, &[422], "no dataset was found", data.path());
    }
    let most = Memory::of(pid).most();
    println!("six together: {} KiB taken", most.saturating_sub(before) >> 10);
    assert!(most < before + TOGETHER * BOUND, "{before} bytes before, {most} at most");
}
