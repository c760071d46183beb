//! The files that fuzzing of the readers began with; what it finds is added by hand.

use std::io::{Cursor, Read as _, Write as _};

use tcgs::{
    domain::{GaussianScene, gaussians::SH_COEFFICIENTS},
    export::{SpzVersion, to_ply, to_spz},
};
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

/// Target, name and content of each.
pub(super) fn first_files() -> Vec<(&'static str, String, Vec<u8>)> {
    let of = |target: &'static str, files: Vec<Vec<u8>>| {
        files.into_iter().enumerate().map(move |(number, bytes)| (target, format!("file-{number:02}"), bytes))
    };
    of("transforms_json", texts(&TRANSFORMS))
        .chain(of("masks", masks()))
        .chain(of("colmap_text", texts(&COLMAP_TEXT)))
        .chain(of("colmap_binary", colmap_binary()))
        .chain(of("ply", [texts(&PLY), vec![to_ply(&scene(3)), binary_points()]].concat()))
        .chain(of("spz", spz()))
        .chain(of("view_query", texts(&QUERIES)))
        .chain(of("upload_headers", texts(&HEADERS)))
        .chain(of("ingest_zip", archives()))
        .collect()
}

/// Masks of every size and name, up to one that is no image.
fn masks() -> Vec<Vec<u8>> {
    let png = |width: u32, height: u32, value: u8| {
        let mut bytes = Cursor::new(Vec::new());
        let mask =
            image::GrayImage::from_fn(width, height, |x, _| image::Luma([if x < 3 { value } else { 0 }]));
        mask.write_to(&mut bytes, image::ImageFormat::Png).expect("encodes");
        bytes.into_inner()
    };
    [
        ("masks/0.png", png(8, 6, 255)),
        ("images/0.png.mask.png\nimages/left/1_mask.png\nmasks/right/1.png.png", png(16, 12, 1)),
        ("images/dynamic_mask_0.png\nsegmentation/0.jpg", png(8, 6, 255)),
        ("masks/0.png\nmasks/left/1.png\nmasks/right/1.png", png(8, 6, 0)),
        ("masks/1.png\n../masks/0.png\nmasks//0.png", png(9, 6, 255)),
        ("mask_0.png\nimages/mask_0.png", b"\x89PNG".to_vec()),
    ]
    .map(|(names, content)| [names.as_bytes(), b"\0", &content].concat())
    .into()
}

fn texts(files: &[&str]) -> Vec<Vec<u8>> {
    files.iter().map(|text| text.as_bytes().to_vec()).collect()
}

const TRANSFORMS: [&str; 5] = [
    r#"{"camera_angle_x":0.8,"frames":[{"file_path":"./train/r_0","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},{"file_path":"./train/r_1","transform_matrix":[[1,0,0,1],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"#,
    r#"{"camera_model":"OPENCV","fl_x":9,"fl_y":9.5,"cx":4.25,"cy":3,"w":8,"h":6.0,"k1":0.01,"k2":-1e-3,"p1":0.001,"p2":0,"applied_transform":[[0,1,0,0],[1,0,0,0],[0,0,-1,5]],"frames":[{"file_path":"images/0.png","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},{"file_path":"images/1.png","fl_x":10,"transform_matrix":[[0,-1,0,0],[1,0,0,0],[0,0,1,4],[0,0,0,1]]}]}"#,
    r#"{"camera_model":"OPENCV_FISHEYE","fl_x":9,"w":8,"h":6,"k1":0.1,"k2":0.01,"k3":0.001,"k4":1e-4,"frames":[{"file_path":"images/0.png","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,4]]},{"file_path":"images/1.png","mask_path":"m.png","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,3]]}],"test_filenames":["images/1.png"],"train_filenames":["images/0.png"]}"#,
    r#"{"fl_x":1e308,"w":8,"h":6,"ply_file_path":"images/0.png","frames":[{"file_path":"images/0.png","transform_matrix":[[1e30,0,0,0],[0,1,0,0],[0,0,0,4],[0,0,0,1]]}]}"#,
    "\u{feff}{\"frames\":[]}",
];

const COLMAP_TEXT: [&str; 5] = [
    "# cameras\n1 PINHOLE 8 6 9 9.5 4.25 3\n\x001 1 0 0 0 0.5 0.25 4 1 0.png\n1 2 -1 3 4 7\n2 1 0 0 0 1.5 0.25 4 1 1.png\n\n\x001 1 2 3 10 20 30 0.1 1 0\n2 -1 2 3 10 20 30 0.1 1 0 2 1\n",
    "1 SIMPLE_RADIAL 8 6 9 4 3 0.01\n2 OPENCV 8 6 9 9 4 3 0.1 0.01 0.001 0\n\x001 0.5 0.5 0.5 0.5 0 0 4 1 0.png\n\n2 1 0 0 0 0 0 4 2 1.png\n\n\x00",
    "1 OPENCV_FISHEYE 8 6 9 9 4 3 0.1 0.01 0.001 1e-4\n\x001 1 0 0 0 0 0 4 1 0.png\r\n\r\n2 1 0 0 0 0 0 5 1 1.png\r\n\r\n\x00",
    "1 FULL_OPENCV 8 6 9 9 4 3 0 0 0 0 0 0 0 0\n\x001 0 0 0 0 nan inf 4 1 ../0.png\n\n\x001 1e39 2 3 256 -1 30 0.1\n",
    "\x00\x00",
];

const PLY: [&str; 4] = [
    "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 10 20 30\n-1 0.5 3e2 255 0 7\n",
    "ply\nformat ascii 1.0\nelement vertex 1\nproperty double z\nproperty int x\nproperty float y\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n1 2 3\n3 0 0 0\n",
    "ply\r\nformat ascii 1.0\r\nelement vertex 99999999999\r\nproperty float x\r\nproperty float y\r\nproperty float z\r\nend_header\r\nnan inf 1e39\r\n",
    "ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\nabcdefghijkl",
];

const QUERIES: [&str; 8] = [
    "position=3,0,0&look_at=0,0,0&width=8&height=6",
    "position=1e2,-0.5,3&look_at=0,0,0&up=0,1,0&fov=45&format=jpeg&quality=80",
    "position=0,0,3&quat=1,0,0,0&fov=179.9",
    "frame=images/0.png&width=4",
    "frame=images%2F0.png&lambda=0.001&format=depth",
    "position=nan,inf,1e400&look_at=0,0,0",
    "position=0,0,0&look_at=0,0,0&up=0,0,0&width=4294967295&height=0",
    "width=8&width=8&%ff=%00&frame=%",
];

const HEADERS: [&str; 6] = [
    "tus-resumable: 1.0.0\nupload-length: 100\nupload-metadata: name cGx1c2g=,filetype emlw,empty\ncontent-length: 0",
    "tus-resumable: 1.0.0\nupload-length: 18446744073709551616",
    "tus-resumable: 1.0.0\nupload-defer-length: 1",
    "tus-resumable: 1.0.0\ncontent-type: application/offset+octet-stream\nupload-offset: 3\nupload-checksum: sha256 ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=\n\nabc",
    "tus-resumable: 1.0.0\ncontent-type: application/offset+octet-stream\nupload-offset: -1\nupload-checksum: md5 AAAA",
    "tus-resumable: 0.2.2\nupload-length: 1\ntransfer-encoding: chunked",
];

/// Two cameras, two images of one point each, and a point.
fn colmap_binary() -> Vec<Vec<u8>> {
    let mut cameras = 2_u64.to_le_bytes().to_vec();
    for (id, model, parameters) in
        [(1_u32, 1_i32, &[9.0, 9.5, 4.25, 3.0][..]), (2, 2, &[9.0, 4.0, 3.0, 0.01])]
    {
        cameras.extend(id.to_le_bytes());
        cameras.extend(model.to_le_bytes());
        cameras.extend([8_u64, 6].iter().flat_map(|side| side.to_le_bytes()));
        cameras.extend(parameters.iter().flat_map(|value: &f64| value.to_le_bytes()));
    }
    let mut images = 2_u64.to_le_bytes().to_vec();
    for id in [1_u32, 2] {
        images.extend(id.to_le_bytes());
        images.extend(
            [1.0, 0.0, 0.0, 0.0, f64::from(id), 0.25, 4.0].iter().flat_map(|v: &f64| v.to_le_bytes()),
        );
        images.extend(id.to_le_bytes());
        images.extend(format!("{}.png\0", id - 1).bytes());
        images.extend(1_u64.to_le_bytes());
        images.extend([1.5_f64, 2.5].iter().flat_map(|value| value.to_le_bytes()));
        images.extend(1_i64.to_le_bytes());
    }
    let mut points = 1_u64.to_le_bytes().to_vec();
    points.extend(1_u64.to_le_bytes());
    points.extend([1.0_f64, 2.0, 3.0].iter().flat_map(|value| value.to_le_bytes()));
    points.extend([10, 20, 30]);
    points.extend(0.1_f64.to_le_bytes());
    points.extend(2_u64.to_le_bytes());
    points.extend([1_u32, 0, 2, 0].iter().flat_map(|value| value.to_le_bytes()));
    let joined = |tables: [&[u8]; 3]| {
        let lengths = [tables[0].len(), tables[1].len()].map(|length| (length as u16).to_le_bytes());
        [&lengths.concat()[..], tables[0], tables[1], tables[2]].concat()
    };
    let huge = u64::MAX.to_le_bytes();
    vec![
        joined([&cameras, &images, &points]),
        joined([&cameras, &images, &[]]),
        joined([&cameras, &images[..images.len() / 2], &points]),
        joined([&cameras, &images, &huge]),
        joined([&huge, &huge, &huge]),
    ]
}

fn binary_points() -> Vec<u8> {
    let mut file = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
                     property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
        .to_vec();
    file.extend([1.0_f32, 2.0, 3.0].iter().flat_map(|value| value.to_le_bytes()));
    file.extend([1, 2, 3]);
    file
}

/// Three Gaussians of this degree.
fn scene(degree: u8) -> GaussianScene {
    let mut scene = GaussianScene { degree, ..GaussianScene::default() };
    for index in 0..3 {
        let at = index as f32;
        scene.means.push([at, 0.5 - at, 2.0]);
        scene.log_scales.push([-3.0, -2.0 - at, -4.0]);
        scene.quats.push([1.0, 0.1 * at, -0.2, 0.3]);
        scene.opacity_logits.push(2.0 - at);
        let mut sh = [[0.0; 3]; SH_COEFFICIENTS];
        let used = (usize::from(degree) + 1).pow(2);
        for (function, value) in sh.iter_mut().take(used).enumerate() {
            *value = [0.1 * at, -0.05 * function as f32, 0.3];
        }
        scene.sh.push(sh);
    }
    scene
}

/// Files of both containers, and what the gzip stream of the older one holds.
fn spz() -> Vec<Vec<u8>> {
    let packed = |degree, version| to_spz(&scene(degree), version).expect("packs").bytes;
    let unpacked = |bytes: &[u8]| {
        let mut content = Vec::new();
        flate2::read::GzDecoder::new(bytes).read_to_end(&mut content).expect("a gzip stream");
        content
    };
    let third = [0, 1, 3].map(|degree| packed(degree, SpzVersion::V3));
    let mut second = unpacked(&third[0]);
    second[4] = 2;
    let mut files: Vec<Vec<u8>> = third.iter().map(|bytes| unpacked(bytes)).collect();
    files.extend([second, third[1].clone(), packed(0, SpzVersion::V4), packed(3, SpzVersion::V4)]);
    files
}

/// Archives as they are, and descriptions: how many entries, for each its name and content, and changed bytes.
fn archives() -> Vec<Vec<u8>> {
    let zipped = |method, prefix: &str| {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        let options = SimpleFileOptions::default().compression_method(method);
        for (name, content) in [
            ("transforms.json", TRANSFORMS[1].as_bytes()),
            ("images/0.png", &super::targets::PNG),
            ("images/1.png", &super::targets::PNG),
        ] {
            zip.start_file(format!("{prefix}{name}"), options).expect("an entry");
            zip.write_all(content).expect("memory is writable");
        }
        zip.finish().expect("an archive").into_inner()
    };
    vec![
        zipped(CompressionMethod::Stored, ""),
        zipped(CompressionMethod::Deflated, "set/"),
        vec![3, 0, 1, 2],
        vec![5, 33, 34, 3, 4, 5, 0],
        vec![6, 1, 2, 3, 4, 5, 7, 4, b'.', b'.', b'/', b'a', 2, 40, 0, 7, 90, 0, 9],
        vec![4, 0, 1, 2, 63, 3, b'b', b'i', b'g', 200, 1, 30, 0, 255],
        b"PK\x05\x06\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0".to_vec(),
    ]
}
