//! Datasets as users of capture programs and trainers reported them: each is read as it was meant, or refused or noted by what is wrong.

use std::io::Cursor;

use image::{
    DynamicImage, ImageBuffer, ImageEncoder as _, Rgb, codecs::png::PngEncoder, metadata::Orientation,
};

use super::{
    fixtures::{SIZE, Set, blender, colmap, file, nerfstudio, png},
    *,
};
use crate::domain::{ExifOrientation, Layout, ReadOptions};

fn loaded(set: &Set) -> Dataset {
    load(&set.directory().path).expect("a dataset")
}

#[track_caller]
fn refused(set: &Set, at: &str, words: &str) {
    for written in [set.directory(), file(&set.archive())] {
        let problem = check(&written.path).expect_err("must be refused");
        assert_eq!((problem.status, problem.file.as_deref()), (422, Some(at)), "{problem}");
        assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
    }
}

#[track_caller]
fn noted(set: &Set, words: &str) {
    let notes = loaded(set).notes;
    assert!(notes.iter().any(|note| note.contains(words)), "{notes:?} should say '{words}'");
    let checked = check(&set.directory().path).expect("a dataset").notes;
    assert_eq!(notes, checked, "a check notes what loading does");
}

/// A text file with one passage replaced wherever it stands.
fn replaced(set: &Set, name: &str, from: &str, to: &str) -> Set {
    let text = String::from_utf8(set.0[name].clone()).expect("text");
    assert!(text.contains(from), "{name} has no '{from}'");
    set.clone().with(name, text.replace(from, to))
}

#[test]
fn photographs_are_no_masks_whatever_their_names() {
    let names = replaced(&colmap(), "sparse/0/images.txt", ".png", "_mask.png");
    let renamed = names.0.into_iter().map(|(name, content)| match name.strip_prefix("images/") {
        Some(image) => (format!("images/{}", image.replace(".png", "_mask.png")), content),
        None => (name, content),
    });
    let set = Set(renamed.collect()).with("images/9_mask.png", png(SIZE, [0; 4]));
    noted(&set, "1 image is not listed");
}

#[test]
fn whatever_is_not_used_has_a_note() {
    let image = png(SIZE, [0, 0, 0, 255]);
    for (name, words) in [
        ("images/extra.png", "1 image is not listed in"),
        ("images_4/0.png", "1 image in images_4/ is not used"),
        ("input/0.jpg", "1 image in input/ is not used"),
        ("depth/0.png", "1 image in depth/ is not used"),
        ("preview.png", "1 image at the top is not used"),
        ("points3D.las", "not used: points3D.las"),
        ("dense/fused.ply", "not used: dense/fused.ply"),
        ("README.md", "not used: README.md"),
        ("database.db", "not used: database.db"),
        ("poses_bounds.npy", "not used: poses_bounds.npy"),
        ("cameras.xml", "not used: cameras.xml"),
        ("sparse/0/rigs.bin", "not used: sparse/0/rigs.bin"),
        ("images/IMG_0001.HEIC", "not used: images/IMG_0001.HEIC"),
        ("images/video.mp4", "not used: images/video.mp4"),
    ] {
        for set in [nerfstudio(), colmap()] {
            noted(&set.with(name, image.clone()), words);
        }
    }
    let merged = Set(colmap().0.into_iter().chain(nerfstudio().0).collect());
    noted(&merged, "not used: sparse/0/cameras.txt, sparse/0/images.txt, sparse/0/points3D.txt");
    noted(&blender().with("transforms.json", "{}"), "not used: transforms.json");
    noted(&blender(), "1 image in val/ is not used");
}

#[test]
fn notes_on_unused_files_are_few_and_short() {
    let mut set = colmap();
    for index in 0..50 {
        set = set
            .with(&format!("folder_{index:02}/{}.png", "x".repeat(200)), "")
            .with(&format!("{index:02}.txt"), "");
    }
    let notes = loaded(&set).notes;
    assert_eq!(notes.len(), 8, "{notes:?}");
    assert!(notes.contains(&"44 images in 44 more folders are not used".to_owned()), "{notes:?}");
    assert_eq!(notes[7], "not used: 00.txt, 01.txt, 02.txt, 03.txt, 04.txt, 05.txt and 44 more files");
}

#[cfg(unix)]
#[test]
fn links_and_names_that_cannot_be_stated_have_a_note() {
    let written = colmap().directory();
    std::os::unix::fs::symlink("/tmp", written.path.join("more")).expect("a link");
    std::fs::write(written.path.join("a\\b"), "").expect("written");
    let notes = check(&written.path).expect("a dataset").notes;
    for words in
        ["links and special files are not followed: more", "1 entry with names that no dataset can state"]
    {
        assert!(notes.iter().any(|note| note.contains(words)), "{notes:?} should say '{words}'");
    }
}

#[test]
fn tables_with_a_byte_order_mark_are_read_and_utf_16_is_called_by_its_name() {
    let marked = |set: &Set, name: &str| {
        let content = [b"\xef\xbb\xbf", set.0[name].as_slice()].concat();
        set.clone().with(name, content)
    };
    for name in ["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"] {
        let dataset = loaded(&marked(&colmap(), name));
        assert_eq!(
            (dataset.frames.len(), dataset.points.map(|cloud| cloud.positions.len())),
            (9, Some(2)),
            "{name}"
        );
    }
    for name in ["transforms.json", "points.ply"] {
        assert_eq!(loaded(&marked(&nerfstudio(), name)).frames.len(), 9, "{name}");
    }
    for name in ["transforms_train.json", "transforms_test.json"] {
        assert_eq!(loaded(&marked(&blender(), name)).frames.len(), 3, "{name}");
    }
    let wide = |text: &[u8]| {
        [&[0xff, 0xfe], text.iter().flat_map(|byte| [*byte, 0]).collect::<Vec<_>>().as_slice()].concat()
    };
    let text = wide(&colmap().0["sparse/0/cameras.txt"]);
    refused(
        &colmap().with("sparse/0/cameras.txt", text),
        "sparse/0/cameras.txt",
        "is UTF-16 text; save it as UTF-8",
    );
    // A mark alone is an empty table.
    refused(&colmap().with("sparse/0/images.txt", "\u{feff}"), "sparse/0/images.txt", "no images");
}

#[test]
fn names_match_in_any_form_of_unicode() {
    let (composed, decomposed) = ("Übung é", "U\u{308}bung e\u{301}");
    for (table, stored) in [(composed, decomposed), (decomposed, composed), (decomposed, decomposed)] {
        let listed = replaced(&colmap(), "sparse/0/images.txt", "1 4.png", &format!("1 {table}.png"));
        let set =
            listed.without("images/4.png").with(&format!("images/{stored}.png"), png(SIZE, [9, 8, 4, 255]));
        for written in [set.directory(), file(&set.archive())] {
            let dataset = load(&written.path).expect("found");
            assert!(dataset.find_frame(&format!("{table}.png")).is_some() && dataset.notes.is_empty());
        }
        let listed = replaced(&nerfstudio(), "transforms.json", "images/4.png", &format!("{table}/4"));
        let cloud = listed.edited("transforms.json", "points.ply", &format!("{table}.ply"));
        let split = format!("\"test_filenames\": [\"{stored}/4\"], \"frames\"");
        let set = cloud
            .edited("transforms.json", "\"frames\"", &split)
            .without("images/4.png")
            .without("points.ply")
            .with(&format!("{stored}/4.png"), png(SIZE, [9, 8, 4, 255]))
            .with(&format!("{stored}.ply"), nerfstudio().0["points.ply"].clone())
            .inside(stored);
        assert_eq!(loaded(&set).split(crate::domain::Split::Test).count(), 1);
    }
}

#[test]
fn backslashes_in_a_zip_are_separators_with_the_same_checks() {
    let windows = |set: Set| {
        let names = set.0.into_iter().map(|(name, content)| (name.replace('/', "\\"), content));
        Set(names.collect()).archive()
    };
    for set in [colmap(), nerfstudio(), blender(), colmap().inside("my set")] {
        let plain = load(&file(&set.archive()).path).expect("a dataset");
        let dataset = load(&file(&windows(set)).path).expect("the same dataset");
        assert_eq!((dataset.digest, dataset.notes), (plain.digest, plain.notes));
    }
    let with_folder = colmap().with("images\\", "").archive();
    assert!(load(&file(&with_folder).path).is_ok(), "the entry of a folder");
    let unsafe_names =
        ["..\\x.png", "images\\..\\..\\x", "\\x.png", "C:\\x.png", "images\\\\x.png", "__\\..\\x"];
    for name in unsafe_names {
        let problem = check(&file(&colmap().with(name, "x").archive()).path).expect_err("leaves the dataset");
        assert_eq!(problem.kind, "urn:tcgs:problem:archive-rejected", "{name}: {problem}");
    }
    let twice = colmap().with("images\\0.png", "x").archive();
    assert!(check(&file(&twice).path).expect_err("two of a name").detail.contains("twice"));
    // Tables of Windows programs have backslashes too.
    let listed = replaced(&colmap(), "sparse/0/images.txt", "1 4.png", "1 cam0\\4.png");
    let set = listed.without("images/4.png").with("images/cam0/4.png", png(SIZE, [9, 8, 4, 255]));
    assert!(loaded(&set).find_frame("cam0/4.png").is_some());
}

#[test]
fn names_in_a_local_code_page_are_said_as_such() {
    let listed = replaced(&colmap(), "sparse/0/images.txt", "1 4.png", "1 图片.png");
    let set = listed.without("images/4.png").with("images/ABCD.png", png(SIZE, [9, 8, 4, 255]));
    // 图片 in GBK, which happens to be UTF-8 too, and 照片, which is not.
    for gbk in [[0xcd, 0xbc, 0xc6, 0xac], [0xd5, 0xd5, 0xc6, 0xac]] {
        let mut archive = set.archive();
        for at in 0..archive.len() - 4 {
            if &archive[at..at + 4] == b"ABCD" {
                archive[at..at + 4].copy_from_slice(&gbk);
            }
        }
        let problem = check(&file(&archive).path).expect_err("cannot be matched");
        for words in ["1 of the 9 images listed here are missing", "local code page", "UTF-8"] {
            assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
        }
    }
    // What a table lists in UTF-8 is found without the mark, which some programs leave out.
    let name = "ü.png";
    let set =
        replaced(&colmap(), "sparse/0/images.txt", "1 4.png", &format!("1 {name}")).without("images/4.png");
    let mut archive = set.with("images/XX.png", png(SIZE, [9, 8, 4, 255])).archive();
    for at in 0..archive.len() - 2 {
        if &archive[at..at + 2] == b"XX" {
            archive[at..at + 2].copy_from_slice("ü".as_bytes());
        }
    }
    assert!(load(&file(&archive).path).expect("found").notes.is_empty());
}

#[test]
fn a_missing_image_with_another_extension_is_named() {
    let set = colmap().without("images/4.png").with("images/4.jpg", "");
    refused(&set, "sparse/0/images.txt", "(there is 'images/4.jpg': extensions must match)");
}

#[test]
fn the_largest_model_is_used() {
    let model = |folder: &str, images: usize| {
        let rows: String =
            (0..images).map(|index| format!("{} 1 0 0 0 0 0 4 1 {index}.png\n\n", index + 1)).collect();
        let table = |name: &str| {
            (format!("{folder}/{name}.txt"), colmap().0[&format!("sparse/0/{name}.txt")].clone())
        };
        Set([table("cameras"), table("points3D"), (format!("{folder}/images.txt"), rows.into_bytes())].into())
    };
    let images = Set(colmap().0.into_iter().filter(|(name, _)| name.starts_with("images/")).collect());
    let merged = |sets: &[Set]| Set(sets.iter().flat_map(|set| set.0.clone()).collect());
    let set = merged(&[images.clone(), model("sparse/0", 3), model("sparse/1", 9), model("sparse/10", 2)]);
    assert_eq!(loaded(&set).frames.len(), 9);
    noted(
        &set,
        "there are 3 models: sparse/1 with 9 images is used, the largest; not used: sparse/0 with 3, sparse/10 with 2",
    );
    for (models, frames) in [
        (vec![model("sparse/1", 4)], 4),
        (vec![model("sparse/0", 5), model("sparse/1", 5)], 5),
        (vec![model("sparse", 9), model("sparse/0", 3)], 9),
        (vec![model("colmap/sparse/0", 2), model("colmap/sparse/1", 7)], 7),
        (vec![model("sparse/0", 3), model("sparse/1", 9).without("sparse/1/images.txt")], 3),
        (
            vec![
                model("sparse/0", 3),
                model("sparse/1", 9).edited("sparse/1/images.txt", "1 1 0", "\u{0}1 1 0"),
            ],
            3,
        ),
    ] {
        let set = merged(&[models, vec![images.clone()]].concat());
        assert_eq!(check(&set.directory().path).map(|summary| summary.train + summary.test), Ok(frames));
    }
    // A binary table says how many there are in its first bytes; one that has no room for them is not believed.
    let claims = [&u64::MAX.to_le_bytes()[..], &[0; 100]].concat();
    let binary = Set::default().with("sparse/1/cameras.bin", "").with("sparse/1/images.bin", claims);
    assert_eq!(loaded(&merged(&[images, model("sparse/0", 3), binary])).frames.len(), 3);
}

#[test]
fn tables_of_one_encoding_are_read_beside_a_leftover_of_the_other() {
    let set = colmap().with("sparse/0/cameras.bin", "left over");
    assert_eq!(loaded(&set).frames.len(), 9);
    noted(&set, "not used: sparse/0/cameras.bin");
}

#[test]
fn a_full_opencv_camera_with_zero_extra_terms_is_the_simpler_one() {
    let plain = loaded(&colmap());
    let full = colmap().edited(
        "sparse/0/cameras.txt",
        "PINHOLE 8 6 9 9.5 4.25 3",
        "FULL_OPENCV 8 6 9 9.5 4.25 3 0 0 0 0 0 0 0 0",
    );
    let dataset = loaded(&full);
    assert!(dataset.frames.iter().zip(&plain.frames).all(|(a, b)| a.camera == b.camera));
    assert_eq!(dataset.notes, plain.notes);
    let model = |model: &str| nerfstudio().edited("transforms.json", "\"OPENCV\"", model);
    assert!(load(&model("\"FULL_OPENCV\", \"k5\": 0.0").directory().path).is_ok());
    for term in ["k4", "k5", "k6"] {
        noted(&model(&format!("\"FULL_OPENCV\", \"{term}\": 0.01")), "images undistorted: 9");
    }
}

#[test]
fn photographs_beside_the_folder_of_the_tables_are_found() {
    let names = |set: &Set| loaded(set).frames.into_iter().map(|frame| frame.name).collect::<Vec<_>>();
    // As nerfstudio writes it into a folder of its own.
    let tables = replaced(&nerfstudio(), "transforms.json", "images/", "../images/");
    let moved = tables.0.into_iter().map(|(name, content)| {
        let folder = if name.starts_with("images/") { "scene" } else { "scene/nerfstudio" };
        (format!("{folder}/{name}"), content)
    });
    let set = Set(moved.collect());
    assert_eq!(names(&set), names(&nerfstudio()));
    assert_eq!(loaded(&set).digest, ingest_of_archive(&set).digest);
    noted(&set, "the dataset is in scene/nerfstudio/, and its photographs are those of scene/");

    // As the converter of 3DGS leaves it before it undistorts the photographs.
    let moved = colmap().0.into_iter().map(|(name, content)| match name.strip_prefix("images/") {
        Some(image) => (format!("input/{image}"), content),
        None => (format!("distorted/{name}"), content),
    });
    let set = Set(moved.collect());
    assert_eq!(names(&set).len(), 9);
    noted(&set.clone().with("input/extra.png", png(SIZE, [0; 4])), "1 image is not listed");
    noted(&set, "the dataset is in distorted/, and its photographs are those of the top");

    // Images that the folder has are its own: another folder's are not taken for those that it lacks.
    let own = set.clone().with("distorted/images/0.png", png(SIZE, [0; 4]));
    refused(&own, "sparse/0/images.txt", "there is 'input/1.png', outside of the dataset's folder");
    // The nearest folder counts.
    let far = Set(set.inside("a").0.into_iter().collect()).with("0.png", png(SIZE, [0; 4]));
    assert_eq!(names(&far).len(), 9);
}

fn ingest_of_archive(set: &Set) -> Dataset {
    load(&file(&set.archive()).path).expect("a dataset")
}

const CLOUD: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                     property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 10 20 30\n-1 2 3 40 50 60\n";

#[test]
fn points_in_ply_beside_colmap_tables_are_read() {
    for name in ["points3D.ply", "points3d.ply"] {
        let set = colmap().without("sparse/0/points3D.txt").with(&format!("sparse/0/{name}"), CLOUD);
        let dataset = loaded(&set);
        assert_eq!(dataset.points.expect("points").colors, [[10, 20, 30], [40, 50, 60]]);
        assert!(dataset.notes.is_empty(), "{:?}", dataset.notes);
    }
    // A table without points, with its header and without: they are in the PLY file.
    for empty in ["", "# 3D point list with one line of data per point:\n# Number of points: 0\n"] {
        let set = colmap().with("sparse/0/points3D.txt", empty);
        noted(&set, "sparse/0/points3D.txt has no points: training starts from random ones");
        let dataset = loaded(&set.with("sparse/0/points3D.ply", CLOUD));
        assert_eq!(dataset.points.expect("points").positions.len(), 2);
        assert!(dataset.notes.is_empty(), "{:?}", dataset.notes);
    }
    noted(&colmap().with("sparse/0/points3D.ply", CLOUD), "not used: sparse/0/points3D.ply");
    refused(&colmap().without("sparse/0/images.txt"), "sparse/0/images.txt", "the points also .ply");
}

#[test]
fn a_blender_set_uses_the_cloud_that_is_named_or_lies_there() {
    assert!(loaded(&blender()).points.is_none());
    let named = blender()
        .edited("transforms_train.json", "\"frames\"", "\"ply_file_path\": \"clouds/mine.ply\", \"frames\"")
        .with("clouds/mine.ply", CLOUD);
    for set in [
        named.clone(),
        named.with("points3d.ply", "another"),
        blender().with("points3d.ply", CLOUD),
        blender().with("points3D.ply", CLOUD),
    ] {
        let dataset = loaded(&set);
        assert_eq!((dataset.layout, dataset.points.expect("points").positions.len()), (Layout::Blender, 2));
    }
    let unnamed = nerfstudio().edited("transforms.json", "\"ply_file_path\": \"points.ply\",", "");
    assert_eq!(
        loaded(&unnamed.clone().with("points3d.ply", CLOUD)).points.expect("points").positions.len(),
        2
    );
    noted(&unnamed.clone(), "names no point cloud (ply_file_path) and there is no points3d.ply");
    noted(&unnamed, "not used: points.ply");
    noted(&blender().with("sparse_pc.ply", CLOUD), "not used: sparse_pc.ply");
}

#[test]
fn a_cloud_without_colors_has_a_note() {
    noted(&nerfstudio(), "the points of points.ply have no colors");
}

#[test]
fn coordinates_of_maps_and_of_the_earth_have_a_note() {
    // Translations of world-to-camera poses without a rotation: cameras are at the negative of them.
    let at = |x: f64, y: f64, z: f64, spread: f64| {
        let rows: String = (0..9)
            .map(|index| {
                let along = spread * f64::from(index) / 8.0;
                format!("{} 1 0 0 0 {} {} {} 1 {index}.png\n\n", index + 1, -(x + along), -y, -z)
            })
            .collect();
        colmap().with("sparse/0/images.txt", rows)
    };
    let utm = (448_262.0, 5_411_945.0, 40.0);
    let ecef = (4_201_000.0, 168_000.0, 4_780_000.0);
    for (x, y, z) in [utm, ecef] {
        for spread in [6.0, 600.0, 20_000.0] {
            noted(&at(x, y, z, spread), "as in UTM or ECEF coordinates");
        }
    }
    noted(&at(5e4, 0.0, 0.0, 6.0), "around (50003, 0, 0), and within 3.000 of each other");
    for near in
        [at(0.0, 0.0, 0.0, 6.0), at(1e3, 1e3, 0.0, 6.0), at(5e5, 0.0, 0.0, 3e5), at(0.0, 0.0, 0.0, 0.0)]
    {
        assert!(loaded(&near).notes.is_empty(), "{:?}", loaded(&near).notes);
    }
}

/// A PNG with an EXIF orientation.
fn oriented(image: &ImageBuffer<Rgb<u8>, Vec<u8>>, orientation: u8) -> Vec<u8> {
    let mut exif = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0]);
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = PngEncoder::new(&mut bytes);
    encoder.set_exif_metadata(exif).expect("PNG has EXIF");
    encoder
        .write_image(image, image.width(), image.height(), image::ExtendedColorType::Rgb8)
        .expect("encodes");
    bytes.into_inner()
}

/// Photographs of a plane of colors, and points on it of its colors. Cameras are those of upright pixels; `orientation` is in the files,
/// whose stored pixels are so turned that it makes them upright if `is_turned`, and upright else.
fn scene(size: (u32, u32), orientation: u8, is_turned: bool, has_colors: bool) -> Set {
    let (width, height) = size;
    let color = |x: f64, y: f64| {
        let wave = |value: f64| (127.0 + 120.0 * value.sin()) as u8;
        [wave(2.0 * x + 0.3), wave(1.3 * y + x), wave(y - 0.7 * x)]
    };
    let focal = f64::from(width);
    let mut set = Set::default();
    let (mut images, mut points) = (String::new(), String::new());
    for index in 0..4_u32 {
        let shift = f64::from(index) * 0.25;
        let upright = ImageBuffer::from_fn(width, height, |column, row| {
            let x = 2.0 * (f64::from(column) + 0.5 - f64::from(width) / 2.0) / focal + shift;
            Rgb(color(x, 2.0 * (f64::from(row) + 0.5 - f64::from(height) / 2.0) / focal))
        });
        let turn = Orientation::from_exif(orientation).expect("an orientation");
        // The inverse: quarter turns go the other way, all others undo themselves.
        let inverse = match turn {
            Orientation::Rotate90 => Orientation::Rotate270,
            Orientation::Rotate270 => Orientation::Rotate90,
            other => other,
        };
        let mut stored = DynamicImage::from(upright);
        if is_turned {
            stored.apply_orientation(inverse);
        }
        set = set.with(&format!("images/{index}.png"), oriented(&stored.into_rgb8(), orientation));
        images += &format!("{} 1 0 0 0 {} 0 2 1 {index}.png\n\n", index + 1, -shift);
    }
    for index in 0..900 {
        let (x, y) = (f64::from(index % 30) * 0.05 - 0.6, f64::from(index / 30) * 0.05 - 0.75);
        let [r, g, b] = if has_colors { color(x, y) } else { [128; 3] };
        points += &format!("{} {x} {y} 0 {r} {g} {b} 0.1\n", index + 1);
    }
    let (x, y) = (width / 2, height / 2);
    set.with("sparse/0/cameras.txt", format!("1 PINHOLE {width} {height} {focal} {focal} {x} {y}\n"))
        .with("sparse/0/images.txt", images)
        .with("sparse/0/points3D.txt", points)
}

fn reading(exif_orientation: ExifOrientation) -> ReadOptions {
    ReadOptions { exif_orientation, ..ReadOptions::default() }
}

/// The pixels of the first frame, and the notes.
fn first_pixels(set: &Set, orientation: ExifOrientation) -> (Vec<u8>, Vec<String>) {
    let dataset = load_as(&set.directory().path, &reading(orientation), &LoadBudget::default(), &|| true)
        .expect("a dataset");
    let summary = check_as(&set.directory().path, &reading(orientation)).expect("a dataset").0;
    assert_eq!(summary.notes, dataset.notes);
    let frame = dataset.find_frame("0.png").expect("a frame");
    let image = frame.image.load().expect("in memory");
    assert_eq!(
        (image.width(), image.height()),
        (frame.camera.intrinsics.width, frame.camera.intrinsics.height)
    );
    (image.samples().to_vec(), dataset.notes)
}

const WIDE: (u32, u32) = (64, 48);
const SQUARE: (u32, u32) = (48, 48);

#[test]
fn an_exif_orientation_is_applied_where_the_cameras_are_those_of_the_turned_pixels() {
    for size in [WIDE, SQUARE] {
        let (upright, none) = first_pixels(&scene(size, 1, false, true), ExifOrientation::Auto);
        assert!(none.is_empty(), "{none:?}");
        for orientation in 2..=8 {
            let swaps = orientation >= 5;
            for is_turned in [true, false] {
                let set = scene(size, orientation, is_turned, true);
                let (pixels, notes) = first_pixels(&set, ExifOrientation::Auto);
                assert!(pixels == upright, "{orientation} of {size:?}, turned: {is_turned}");
                let done =
                    if is_turned { "applied to 4 photographs" } else { "not applied to 4 photographs" };
                let why = if swaps && size == WIDE {
                    "their cameras have the size"
                } else {
                    "the points' colors differ"
                };
                assert!(notes.len() == 1 && notes[0].contains(done) && notes[0].contains(why), "{notes:?}");
            }
        }
    }
}

#[test]
fn the_option_overrides_what_is_found() {
    let set = scene(WIDE, 3, true, true);
    let (upright, _) = first_pixels(&set, ExifOrientation::Apply);
    let (stored, notes) = first_pixels(&set, ExifOrientation::Ignore);
    assert_eq!(stored.chunks_exact(3).rev().collect::<Vec<_>>().concat(), upright);
    assert_eq!(notes, ["EXIF orientation not applied to 4 photographs: exif_orientation=ignore"]);
    let quarter = scene(WIDE, 6, true, true).directory();
    let problem = load_as(&quarter.path, &reading(ExifOrientation::Ignore), &LoadBudget::default(), &|| true);
    let detail = problem.expect_err("another size").to_string();
    assert!(detail.contains("exif_orientation"), "the option is named: {detail}");
}

#[test]
fn without_colors_pixels_stay_as_stored_unless_other_photographs_tell() {
    for set in [
        scene(WIDE, 3, true, false).with("sparse/0/points3D.txt", ""),
        scene(SQUARE, 6, true, false).with("sparse/0/points3D.txt", ""),
        scene(WIDE, 3, true, false),
    ] {
        let (pixels, notes) = first_pixels(&set, ExifOrientation::Auto);
        assert!(pixels == first_pixels(&set, ExifOrientation::Ignore).0);
        assert!(notes.iter().any(|note| note.contains("not applied to 4 photographs")), "{notes:?}");
    }
    let mixed = scene(WIDE, 3, true, false)
        .with("images/3.png", scene(WIDE, 6, true, false).0["images/3.png"].clone())
        .with("sparse/0/points3D.txt", "");
    let (pixels, notes) = first_pixels(&mixed, ExifOrientation::Auto);
    assert!(pixels == first_pixels(&mixed, ExifOrientation::Apply).0, "{notes:?}");
}

#[test]
fn a_check_of_an_upload_decodes_nothing_and_says_that_training_will() {
    let notes = check(&scene(WIDE, 3, true, true).directory().path).expect("a dataset").notes;
    assert_eq!(
        notes,
        [
            "4 photographs have an EXIF orientation and cameras whose size does not tell whether it applies: training compares their \
          pixels with the points' colors"
        ]
    );
    let notes = check(&scene(WIDE, 6, true, true).directory().path).expect("a dataset").notes;
    assert_eq!(
        notes,
        ["EXIF orientation applied to 4 photographs: their cameras have the size of the turned pixels"]
    );
}
