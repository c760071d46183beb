//! Whole datasets through the public functions: accepted ones are read correctly, and each refused one gives the right status, file
//! and message, as a directory and as a zip.

use std::io::{Cursor, Write as _};

use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::{
    fixtures::{SIZE, Set, blender, colmap, file, nerfstudio, png},
    *,
};
use crate::domain::{Convention, DatasetSummary, HoldOut, Layout, MaxWidth, ReadOptions, Split};

fn refused(set: &Set) -> Problem {
    let directory = set.directory();
    let from_directory = check(&directory.path).err();
    let from_archive = check(&file(&set.archive()).path).err();
    assert_eq!(from_directory, from_archive, "a directory and its zip must be refused alike");
    let problem = from_directory.expect("must be refused before pixels are decoded");
    assert_eq!(load(&directory.path).expect_err("must be refused"), problem);
    problem
}

#[track_caller]
fn assert_refused(set: &Set, at: &str, words: &str) {
    let problem = refused(set);
    assert_eq!(problem.status, 422, "{problem}");
    assert_eq!(problem.file.as_deref(), Some(at), "{problem}");
    assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
}

fn names(dataset: &Dataset, split: Split) -> Vec<&str> {
    dataset.split(split).map(|frame| frame.name.as_str()).collect()
}

#[test]
fn cameras_are_those_of_the_frames() {
    for set in [blender(), colmap()] {
        let set = set.directory();
        let dataset = load(&set.path).expect("a dataset");
        let frames = dataset.frames.iter().map(|frame| (&frame.name, frame.split, &frame.camera));
        let cameras = super::cameras(&set.path).expect("cameras");
        assert!(cameras.iter().map(|camera| (&camera.name, camera.split, &camera.camera)).eq(frames));
    }
}

#[test]
fn a_blender_set_keeps_its_splits_names_alpha_and_field_of_view() {
    let dataset = load(&blender().directory().path).expect("a dataset");
    assert_eq!(dataset.layout, Layout::Blender);
    assert_eq!(names(&dataset, Split::Train), ["train/r_0", "train/r_1"]);
    assert_eq!(names(&dataset, Split::Test), ["test/r_0"]);
    assert!(dataset.points.is_none());
    let frame = dataset.find_frame("train/r_0").expect("a frame");
    let image = frame.image.load().expect("in memory");
    assert_eq!((image.channels(), &image.samples()[..4]), (4, [10, 20, 30, 128].as_slice()));
    let k = frame.camera.intrinsics;
    assert!((k.fx - 4.0 / 0.4_f64.tan()).abs() < 1e-12 && k.fx == k.fy);
    assert_eq!((k.cx, k.cy), (4.0, 3.0));
    let pose = frame.camera.pose.camera_to_world(Convention::Opengl);
    assert_eq!(pose.w_axis.truncate().to_array(), [0.5, 0.25, 4.0]);
    assert_eq!(pose.z_axis.truncate().to_array(), [0.0, 0.0, 1.0]);
}

#[test]
fn without_a_test_file_validation_or_every_eighth_image_is_held_out() {
    let validated = load(&blender().without("transforms_test.json").directory().path).expect("a dataset");
    assert_eq!(names(&validated, Split::Test), ["val/r_0"]);
    assert!(validated.notes[0].contains("transforms_val.json is held out"), "{:?}", validated.notes);
    let alone = blender().without("transforms_test.json").without("transforms_val.json");
    let dataset = load(&alone.directory().path).expect("a dataset");
    assert_eq!(names(&dataset, Split::Test), ["train/r_0"]);
    assert_eq!(names(&dataset, Split::Train), ["train/r_1"]);
}

#[test]
fn a_test_file_without_frames_is_none() {
    let empty = blender().with("transforms_test.json", r#"{"camera_angle_x": 0.8, "frames": []}"#);
    let validated = load(&empty.directory().path).expect("a dataset");
    assert_eq!(names(&validated, Split::Test), ["val/r_0"]);
    let note = "transforms_test.json has no frames: transforms_val.json is held out instead";
    assert!(validated.notes.iter().any(|found| found == note), "{:?}", validated.notes);
    let alone = load(&empty.without("transforms_val.json").directory().path).expect("a dataset");
    assert_eq!(names(&alone, Split::Test), ["train/r_0"]);
}

#[test]
fn paths_and_sides_are_understood_as_exporters_on_windows_write_them() {
    let written = blender().edited("transforms_train.json", "./train/r_0", r"train\\r_0").edited(
        "transforms_train.json",
        "0.8,",
        "0.8, \"w\": 8.000000000000002, \"h\": 5.999999999999999,",
    );
    let dataset = load(&written.directory().path).expect("a dataset");
    assert_eq!(names(&dataset, Split::Train), ["train/r_0", "train/r_1"]);
    assert_refused(
        &blender().edited("transforms_train.json", "0.8,", "0.8, \"w\": 8.4, \"h\": 6,"),
        "transforms_train.json",
        "whole number",
    );
    assert_refused(
        &blender().edited("transforms_train.json", "./train/r_0", r"..\\train\\.."),
        "transforms_train.json",
        "..",
    );
}

#[test]
fn nerfstudio_and_colmap_hold_out_every_eighth_image_by_name() {
    for (set, test, points) in
        [(nerfstudio(), ["images/0.png", "images/8.png"], 1), (colmap(), ["0.png", "8.png"], 2)]
    {
        let written = set.directory();
        let dataset = load(&written.path).expect("a dataset");
        assert_eq!(names(&dataset, Split::Test), test);
        assert_eq!(names(&dataset, Split::Train).len(), 7);
        let cloud = dataset.points.as_ref().expect("points");
        assert_eq!((cloud.positions.len(), cloud.positions[0]), (points, [1.0, 2.0, 3.0]));
        let k = dataset.frames[0].camera.intrinsics;
        assert_eq!((k.fx, k.fy, k.cx, k.cy, k.width, k.height), (9.0, 9.5, 4.25, 3.0, 8, 6));
        let image = dataset.frames[0].image.load().expect("in memory");
        assert_eq!(image.channels(), 3, "opaque alpha is dropped");
        let summary = check(&written.path).expect("a summary");
        assert_eq!(
            summary,
            DatasetSummary {
                layout: dataset.layout,
                train: 7,
                test: 2,
                pixels: 9 * 48,
                points: Some(points),
                notes: dataset.notes.clone(),
            }
        );
        let cameras = cameras(&written.path).expect("cameras");
        assert_eq!(check_with_cameras(&written.path), Ok((summary, cameras)));
    }
}

#[test]
fn a_sector_is_the_eighth_of_all_cameras_next_to_the_first() {
    let sector = ReadOptions { holdout: HoldOut::Sector, ..ReadOptions::default() };
    let held_out = |set: &Set| {
        let written = set.directory();
        let dataset = load_as(&written.path, &sector, &LoadBudget::default(), &|| true).expect("a dataset");
        let note = dataset.notes.iter().find(|note| note.contains("a sector is held out")).expect("a note");
        let test: Vec<String> = names(&dataset, Split::Test).into_iter().map(str::to_owned).collect();
        (test, names(&dataset, Split::Train).len(), note.clone())
    };
    // Half a circle, along which names go in another order.
    let mut half_circle = Set::default();
    let frames: Vec<String> = (0..16)
        .map(|place| {
            let name = format!("{:02}.png", place * 5 % 16);
            half_circle = std::mem::take(&mut half_circle).with(&name, png(SIZE, [1, 2, 3, 255]));
            let (y, x) = (f64::from(place) * std::f64::consts::PI / 16.0).sin_cos();
            let matrix = format!("[[1,0,0,{x}],[0,1,0,{y}],[0,0,1,4],[0,0,0,1]]");
            format!("{{\"file_path\": \"{name}\", \"transform_matrix\": {matrix}}}")
        })
        .collect();
    let table = format!("{{\"fl_x\": 9, \"frames\": [{}]}}", frames.join(","));
    let (names, training, note) = held_out(&half_circle.with("transforms.json", table));
    assert_eq!((names, training), (vec!["00.png".to_owned(), "05.png".to_owned()], 14));
    assert!(note.contains("the 2 photographs whose cameras are nearest to that of 00.png"), "{note}");
    // A layout's own test views are among those to choose from.
    let (names, training, _) = held_out(&blender());
    assert_eq!((names, training), (vec!["test/r_0".to_owned()], 2));
}

#[test]
fn a_single_image_is_trained_on() {
    let table = "{\"fl_x\": 9, \"frames\": [{\"file_path\": \"a.png\", \"transform_matrix\": \
                 [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}]}";
    let set = Set::default().with("transforms.json", table).with("a.png", png(SIZE, [1, 2, 3, 255]));
    let dataset = load(&set.directory().path).expect("a dataset");
    assert_eq!((names(&dataset, Split::Train), names(&dataset, Split::Test).len()), (vec!["a.png"], 0));
    assert!(dataset.points.is_none() && dataset.notes[0].contains("random points"), "{:?}", dataset.notes);
}

#[test]
fn the_split_lists_of_a_transforms_file_are_honored() {
    let lists =
        |text: &str| nerfstudio().edited("transforms.json", "\"frames\"", &format!("{text}, \"frames\""));
    let both =
        lists(r#""train_filenames": ["./images/1.png", "images/2.png"], "test_filenames": ["images/3.png"]"#);
    let dataset = load(&both.directory().path).expect("a dataset");
    assert_eq!(names(&dataset, Split::Train), ["images/1.png", "images/2.png"]);
    assert_eq!(names(&dataset, Split::Test), ["images/3.png"]);
    assert!(
        dataset.notes.iter().any(|note| note.starts_with("6 frames are in no split")),
        "{:?}",
        dataset.notes
    );
    let validation = lists(r#""val_filenames": ["images/3.png"], "test_filenames": []"#);
    let dataset = load(&validation.directory().path).expect("a dataset");
    assert_eq!(
        (names(&dataset, Split::Train).len(), names(&dataset, Split::Test)),
        (8, vec!["images/3.png"])
    );
    assert_refused(
        &lists(r#""test_filenames": ["images/77.png"]"#),
        "transforms.json",
        "test_filenames names 'images/77.png'",
    );
    assert_refused(&lists(r#""train_filenames": []"#), "transforms.json", "no images to train on");
}

#[test]
fn frames_may_state_their_own_intrinsics() {
    let own = "\"file_path\": \"images/1.png\", \"fl_x\": 20, \"cx\": 1.5, \"w\": 16, \"h\": 12";
    let set = nerfstudio().edited("transforms.json", "\"file_path\": \"images/1.png\"", own);
    let dataset = load(&set.directory().path).expect("a dataset");
    let k = dataset.find_frame("images/1.png").expect("a frame").camera.intrinsics;
    // Stated at 16x12 and stored at 8x6: halved. The shared fl_y does not go with a frame's own fl_x.
    assert_eq!((k.fx, k.fy, k.cx, k.cy, k.width), (10.0, 10.0, 0.75, 1.5, 8));
    let k = dataset.find_frame("images/2.png").expect("a frame").camera.intrinsics;
    assert_eq!((k.fx, k.fy, k.cx), (9.0, 9.5, 4.25));
    assert!(dataset.notes.iter().any(|note| note.starts_with("images smaller than their camera states: 1;")));
}

#[test]
fn layouts_are_told_apart_by_content() {
    let merged = |a: Set, b: Set| Set(b.0.into_iter().chain(a.0).collect());
    for (set, layout) in [
        (merged(nerfstudio(), colmap()), Layout::Nerfstudio),
        (merged(blender(), nerfstudio()), Layout::Blender),
        (merged(blender(), colmap()), Layout::Blender),
        (colmap(), Layout::Colmap),
    ] {
        assert_eq!(check(&set.directory().path).expect("a dataset").layout, layout);
    }
    for folder in ["sparse", "colmap/sparse/0"] {
        let moved = colmap().0.into_iter().map(|(name, content)| (name.replace("sparse/0", folder), content));
        let summary = check(&Set(moved.collect()).directory().path).expect("a dataset");
        assert_eq!((summary.layout, summary.train), (Layout::Colmap, 7));
    }
}

#[test]
fn nesting_litter_and_packing_do_not_change_what_is_read() {
    for set in [blender(), nerfstudio(), colmap()] {
        let plain = load(&set.directory().path).expect("a dataset");
        let littered = set
            .clone()
            .with(".DS_Store", "x")
            .with("__MACOSX/._transforms.json", "x")
            .with("images/._0.png", "not an image");
        for path in [
            file(&set.archive()),
            file(&set.clone().inside("my set").archive()),
            set.clone().inside("my set").directory(),
            file(&set.clone().inside("a").with("__MACOSX/a/._b", "x").with(".DS_Store", "x").archive()),
            littered.directory(),
            file(&littered.archive()),
        ] {
            let dataset = load(&path.path).expect("a dataset");
            assert_eq!(dataset.digest, plain.digest, "{:?}", path.path);
            assert_eq!(names(&dataset, Split::Train), names(&plain, Split::Train));
            assert_eq!(dataset.notes, plain.notes);
        }
    }
}

#[test]
fn the_digest_covers_names_and_contents_of_used_files_only() {
    let digest = |set: Set| load(&set.directory().path).expect("a dataset").digest;
    let plain = digest(colmap());
    assert_ne!(digest(colmap().with("images/3.png", png(SIZE, [9, 8, 7, 255]))), plain);
    assert_ne!(digest(colmap().edited("sparse/0/points3D.txt", "0.1", "0.2")), plain);
    assert_eq!(digest(colmap().with("sparse/0/rigs.bin", "ignored")), plain);
    assert_eq!(digest(colmap().with("notes.txt", "not part of any layout")), plain);
    assert_eq!(digest(colmap().with("images/unlisted.png", png(SIZE, [0; 4]))), plain);
}

#[test]
fn unlisted_images_are_noted() {
    let set = colmap().with("images/extra.JPG", "").with("images/mask.txt", "").with("other/a.png", "");
    let dataset = load(&set.directory().path).expect("a dataset");
    assert_eq!(
        dataset.notes,
        [
            "1 image is not listed in sparse/0/images.txt and not used",
            "1 image in other/ is not used",
            "not used: images/mask.txt"
        ]
    );
}

#[test]
fn distorted_and_wide_images_become_pinhole_images_of_training_width() {
    let wide = png((1680, 12), [200, 100, 50, 255]);
    let table = "{\"fl_x\": 900, \"cx\": 830, \"cy\": 6, \"w\": 1680, \"h\": 12, \"k1\": 0.02, \"frames\": \
                 [{\"file_path\": \"a.png\", \"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}]}";
    let set = Set::default().with("transforms.json", table).with("a.png", wide);
    let dataset = load(&set.directory().path).expect("a dataset");
    let frame = &dataset.frames[0];
    let k = frame.camera.intrinsics;
    assert_eq!((frame.image.width(), frame.image.height()), (k.width, k.height));
    assert_eq!(k.width, 1600);
    let image = frame.image.load().expect("in memory");
    assert!(image.samples().chunks_exact(3).all(|pixel| pixel == [200, 100, 50]));
    assert!(
        dataset.notes.iter().any(|note| note.starts_with("images undistorted: 1, cropped")),
        "{:?}",
        dataset.notes
    );
    assert!(dataset.notes.iter().any(|note| note.contains("wider than 1600")), "{:?}", dataset.notes);
}

#[test]
fn photographs_are_as_wide_as_asked_for() {
    let table = "{\"fl_x\": 900, \"cx\": 30, \"cy\": 6, \"w\": 60, \"h\": 12, \"frames\": \
                 [{\"file_path\": \"a.png\", \"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}]}";
    let wide = png((60, 12), [200, 100, 50, 255]);
    let set = Set::default().with("transforms.json", table).with("a.png", wide);
    let of = |pixels| {
        let max_width = MaxWidth::new(pixels).expect("a width");
        let reading = ReadOptions { max_width, ..ReadOptions::default() };
        load_as(&set.directory().path, &reading, &LoadBudget::default(), &|| true).expect("a dataset")
    };
    let small = of(20);
    let k = small.frames[0].camera.intrinsics;
    assert_eq!((k.width, k.height, k.fx, k.cx, k.cy), (20, 4, 300.0, 10.0, 2.0));
    assert_eq!((small.frames[0].image.width(), small.frames[0].image.height()), (20, 4));
    assert_eq!(
        small.notes.last().expect("a note"),
        "images wider than 20 pixels, downscaled to that width: 1"
    );
    let whole = of(8192);
    assert_eq!((whole.frames[0].camera.intrinsics.width, whole.notes.len()), (60, small.notes.len() - 1));
}

#[test]
fn faults_of_transforms_files_are_refused_by_file_and_cause() {
    const FILE: &str = "transforms.json";
    for (from, to, words) in [
        ("9.0", "0.0", "/frames/0: the focal length is 0"),
        ("9.0", "-9.0", "the focal length is -9"),
        ("9.0", "NaN", "line 1 column"),
        ("9.0", "1e999", "number out of range"),
        ("9.0", "\"9\"", "invalid type"),
        ("\"fl_x\": 9.0, ", "", "neither fl_x nor camera_angle_x"),
        ("\"OPENCV\"", "\"ORTHOPHOTO\"", "camera model ORTHOPHOTO is not supported"),
        (
            "\"OPENCV\"",
            "\"EQUIRECTANGULAR\"",
            "/frames/0: EQUIRECTANGULAR pictures show more than a perspective one",
        ),
        ("\"OPENCV\"", "\"VR180_L\"", "ns-process-data images --camera-type equirectangular"),
        ("\"OPENCV\"", "\"FISHEYE624\"", "/frames/0: FISHEYE624 needs the 12 numbers of distortion_params"),
        ("\"OPENCV\"", "\"FISHEYE624\", \"distortion_params\": [0, 0]", "needs the 12 numbers"),
        ("\"OPENCV\"", "\"OPENCV_FISHEYE\", \"k4\": -1e9", "less than half"),
        ("\"w\": 8", "\"w\": 8.5", "w is 8.5"),
        ("\"w\": 8", "\"w\": -8", "w is -8"),
        ("\"w\": 8, ", "", "only one of w and h"),
        ("[0,1,0,0.25]", "[0,2,0,0.25]", "/frames/0/transform_matrix: the pose is not rigid"),
        ("[0,1,0,0.25]", "[0,-1,0,0.25]", "the pose is not rigid"),
        ("[0,1,0,0.25]", "[0,1,0,1e999]", "number out of range"),
        (
            "[0,1,0,0.25]",
            "[0,1,0]",
            "/frames/0/transform_matrix: must be a matrix of 4 rows (or 3) of 4 numbers",
        ),
        ("[0,1,0,0.25],", "", "the pose is not rigid"),
        ("[0,0,0,1]]", "[0,0,0,2]]", "the last row of the pose"),
        ("images/1.png", "images/0.png", "'images/0.png' is listed twice"),
        ("images/1.png", "images/0", "'images/0.png' is listed twice"),
        ("images/1.png", "../..", "/frames/1/file_path: '../..': the name is not safe"),
        ("images/1.png", "/etc/", "absolute path"),
        ("images/1.png", "../x.png", "1 of the 9 images listed here are missing: ../x.png"),
        ("images/1.png", "images/x.png", "1 of the 9 images listed here are missing: images/x.png"),
        ("images/1.png", "images/1.Png", "(there is 'images/1.png': upper and lower case must match)"),
        ("\"frames\": [", "\"frames\": [], \"other\": [", "no images to train on"),
        ("\"frames\"", "\"other\"", "missing field `frames`"),
        ("\"k1\": 0.0", "\"k1\": 1e308", "less than half"),
        ("points.ply", "../points.ply", "/ply_file_path: '../points.ply'"),
    ] {
        let set = nerfstudio().edited(FILE, from, to);
        let at = if words == "less than half" { "images/0.png" } else { FILE };
        assert_refused(&set, at, words);
    }
    assert_refused(&nerfstudio().without("points.ply"), "points.ply", "the file is missing");
    assert_refused(&nerfstudio().with("points.ply", "ply\n"), "points.ply", "is not a usable point cloud");
    assert_refused(
        &blender().edited("transforms_test.json", "0.8", "0"),
        "transforms_test.json",
        "focal length",
    );
    assert_refused(&blender().without("train/r_1.png"), "transforms_train.json", "missing: train/r_1");
    assert_refused(
        &blender().without("transforms_train.json").with("transforms.json", "[]"),
        FILE,
        "invalid type",
    );
}

#[test]
fn faults_of_colmap_tables_are_refused_by_file_and_cause() {
    for (table, from, to, words) in [
        ("cameras.txt", "PINHOLE", "SPHERE", "camera 1: camera model SPHERE is not supported"),
        (
            "cameras.txt",
            "PINHOLE 8 6 9 9.5 4.25 3",
            "EQUIRECTANGULAR 8 6 8 6",
            "camera 1: EQUIRECTANGULAR pictures show",
        ),
        (
            "cameras.txt",
            "PINHOLE 8 6 9 9.5 4.25 3",
            "OPENCV_FISHEYE 8 6 9 9.5 4.25 3 nan 0 0 0",
            "camera 1: a distortion coefficient is not finite",
        ),
        (
            "cameras.txt",
            "PINHOLE 8 6 9 9.5 4.25 3",
            "EUCM 8 6 9 9.5 4.25 3 0.5 inf",
            "camera 1: a distortion coefficient is not finite",
        ),
        ("cameras.txt", "8 6 9 9.5", "8 6 0 9.5", "camera 1: the focal length is 0"),
        ("cameras.txt", "8 6 9 9.5", "8 6 nan 9.5", "camera 1: the focal length is NaN"),
        ("cameras.txt", "4.25 3\n", "4.25 3\n1 PINHOLE 8 6 9 9 4 3\n", "'camera 1' is listed twice"),
        ("images.txt", "1 1 0 0 0", "1 0 0 0 0", "image 1: the rotation quaternion has length 0"),
        ("images.txt", "1 1 0 0 0", "1 inf 0 0 0", "image 1: the pose has a non-finite entry"),
        ("images.txt", "4 1 0.png", "nan 1 0.png", "image 1: the pose has a non-finite entry"),
        ("images.txt", "4 1 0.png", "4 2 0.png", "image 1: there is no camera 2"),
        ("images.txt", "0.png", "1.png", "'1.png' is listed twice"),
        ("images.txt", "0.png", "../images/..", "image 1: '../images/..': the name is not safe"),
        ("images.txt", "0.png", "z.png", "1 of the 9 images listed here are missing: images/z.png"),
        ("points3D.txt", "1 1 2 3", "1 1 nan 3", "point 1: the position is not finite"),
    ] {
        let file = format!("sparse/0/{table}");
        assert_refused(&colmap().edited(&file, from, to), &file, words);
    }
    assert_refused(&colmap().without("sparse/0/images.txt"), "sparse/0/images.txt", "the file is missing");
    assert_refused(&colmap().with("sparse/0/images.txt", "# none\n"), "sparse/0/images.txt", "no images");
    assert_refused(&colmap().with("sparse/0/images.txt", [0xff]), "sparse/0/images.txt", "not UTF-8");
}

#[test]
fn a_model_of_known_cameras_without_points_starts_from_random_ones() {
    let set = colmap().with("sparse/0/points3D.txt", "# none\n").directory();
    let dataset = load(&set.path).expect("a dataset");
    assert!(dataset.points.is_none());
    assert_eq!(dataset.notes, ["sparse/0/points3D.txt has no points: training starts from random ones"]);
    let set = colmap().without("sparse/0/points3D.txt").directory();
    let dataset = load(&set.path).expect("a dataset");
    assert!(dataset.points.is_none());
    assert_eq!(dataset.notes, ["there is no sparse/0/points3D.txt: training starts from random points"]);
}

#[test]
fn images_that_do_not_fit_their_camera_are_refused() {
    for (size, words) in [
        ((9, 6), "the image has 9x6 pixels and its camera 8x6"),
        ((16, 12), "the image has 16x12 pixels"),
        ((4, 6), "evenly scaled-down"),
        ((6, 8), "turned by 90 degrees"),
    ] {
        for set in [nerfstudio(), colmap()] {
            assert_refused(&set.with("images/4.png", png(size, [0, 0, 0, 255])), "images/4.png", words);
        }
    }
    assert_refused(
        &colmap().with("images/4.png", "no image"),
        "images/4.png",
        "not a readable PNG, JPEG or WebP",
    );
    assert_refused(&colmap().with("images/4.png", ""), "images/4.png", "not a readable");
}

#[test]
fn headers_behind_previews_are_found_up_to_a_bound() {
    let mut bytes = Cursor::new(Vec::new());
    image::DynamicImage::new_rgb8(SIZE.0, SIZE.1)
        .write_to(&mut bytes, image::ImageFormat::Jpeg)
        .expect("encodes");
    let plain = bytes.into_inner();
    let with_segments = |count: usize| {
        // Pixels and profiles of previews, which cannot be compressed.
        let noise =
            std::iter::successors(Some(1_u32), |last| Some(last.wrapping_mul(747_796_405).wrapping_add(1)));
        let mut noise = noise.map(|value| (value >> 24) as u8);
        let mut bytes = plain[..2].to_vec();
        for _ in 0..count {
            bytes.extend([0xff, 0xe1, 0xff, 0xff]);
            bytes.extend(noise.by_ref().take(0xfffd));
        }
        bytes.extend(&plain[2..]);
        bytes
    };
    let set = |segments| {
        let table = "1 1 0 0 0 0 0 0 1 a.jpg\n\n";
        colmap().with("sparse/0/images.txt", table).with("images/a.jpg", with_segments(segments))
    };
    assert!(load(&set(4).directory().path).is_ok());
    assert_refused(&set(20), "images/a.jpg", "header ends within its first 1048576 bytes");
}

#[test]
fn no_refusal_names_a_folder_of_the_machine() {
    let nothing = Set::default().with("readme.txt", "hello");
    let cut = nerfstudio().archive();
    for written in [nothing.directory(), file(&nothing.archive()), file(&cut[..cut.len() / 2]), file(b"PK")] {
        let problem = check(&written.path).expect_err("no dataset");
        let folder = written.path.parent().expect("a folder").to_string_lossy().into_owned();
        assert!(!problem.to_string().contains(&folder), "{problem}");
    }
    let limits = Limits { entries: 0, ..Limits::default() };
    let written = nerfstudio().directory();
    let problem = Problem::from(check_within(&written.path, &limits).expect_err("too many"));
    assert_eq!((problem.status, problem.file), (413, None));
}

#[test]
fn pixels_that_cannot_be_decoded_are_refused_when_loading() {
    let mut cut = png(SIZE, [1, 2, 3, 255]);
    cut.truncate(cut.len() - 20);
    let set = colmap().with("images/4.png", cut).directory();
    assert!(check(&set.path).is_ok(), "the header is whole");
    let problem = load(&set.path).expect_err("the pixels are not");
    assert_eq!((problem.status, problem.file.as_deref()), (422, Some("images/4.png")));
}

#[test]
fn nothing_that_looks_like_a_dataset_is_refused_as_such() {
    let nothing = refused(&Set::default().with("readme.txt", "hello").with("deep/er/cameras.txt", "{}"));
    assert_eq!((nothing.status, nothing.file.clone()), (422, None));
    assert!(nothing.detail.contains("no dataset was found"), "{nothing}");
    let two_folders = Set(nerfstudio().inside("a").0.into_iter().chain(colmap().inside("b").0).collect());
    assert!(refused(&two_folders).detail.contains("there are 2 datasets, in a/, b/: send one of them"));
    let absent = check(Path::new("/nonexistent/dataset")).expect_err("there is none");
    assert_eq!((absent.status, absent.file.as_deref()), (404, None), "the path is the caller's to name");
}

#[test]
fn no_prefix_of_a_transforms_file_is_accepted() {
    let set = nerfstudio();
    let written = set.directory();
    let path = written.path.join("transforms.json");
    let whole = &set.0["transforms.json"];
    for length in 0..whole.len() {
        std::fs::write(&path, &whole[..length]).expect("written");
        let problem = check(&written.path).expect_err("a prefix is no JSON document");
        assert!(problem.detail.contains("line") && problem.detail.contains("column"), "{length}: {problem}");
    }
}

#[test]
fn no_prefix_of_an_archive_is_accepted_and_damage_never_panics() {
    let whole = blender().archive();
    for length in (0..whole.len()).step_by(7) {
        let problem = check(&file(&whole[..length]).path).expect_err("a prefix is no archive");
        assert_eq!(problem.status, if length < 2 { 400 } else { 422 }, "{length}: {problem}");
    }
    let plain = load(&file(&whole).path).expect("a dataset");
    let directory = whole.windows(4).position(|bytes| bytes == b"PK\x01\x02").expect("a central directory");
    for at in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x11;
        // Some bytes (dates, attributes) do not matter; then the dataset must be the same one. Only the central
        // directory has no checksum: damage there may rename a file, which makes it another dataset.
        if let Ok(dataset) = load(&file(&damaged).path) {
            assert!(dataset.digest == plain.digest || at >= directory, "byte {at}");
        }
    }
}

/// An archive of entries as given, each (name, content, options).
fn archive_of(entries: &[(&str, &[u8], SimpleFileOptions)]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, content, options) in entries {
        zip.start_file(*name, *options).expect("an entry");
        zip.write_all(content).expect("written");
    }
    zip.finish().expect("an archive").into_inner()
}

/// Every occurrence of `from` replaced by the equally long `to`.
fn patched(mut bytes: Vec<u8>, from: &[u8], to: &[u8]) -> Vec<u8> {
    assert_eq!(from.len(), to.len());
    let mut found = false;
    for at in 0..bytes.len() - from.len() {
        if bytes[at..].starts_with(from) {
            bytes[at..at + from.len()].copy_from_slice(to);
            found = true;
        }
    }
    assert!(found);
    bytes
}

/// `value` written at `offset` of every header with this signature.
fn with_header_field(mut bytes: Vec<u8>, signature: &[u8; 4], offset: usize, value: &[u8]) -> Vec<u8> {
    for at in 0..bytes.len() - 4 {
        if bytes[at..].starts_with(signature) {
            bytes[at + offset..at + offset + value.len()].copy_from_slice(value);
        }
    }
    bytes
}

#[test]
fn hostile_archives_are_refused_by_entry_and_cause() {
    const LOCAL: &[u8; 4] = b"PK\x03\x04";
    const CENTRAL: &[u8; 4] = b"PK\x01\x02";
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let deflated = SimpleFileOptions::default();
    let zeros = vec![0; 4 << 20];
    let one = archive_of(&[("a.png", b"abc", stored)]);
    let two = archive_of(&[("a.png", b"abc", stored), ("b.png", b"abc", stored)]);
    let link = {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        zip.add_symlink("images", "/etc", SimpleFileOptions::default()).expect("a link");
        zip.finish().expect("an archive").into_inner()
    };
    let marked =
        |value| with_header_field(with_header_field(one.clone(), LOCAL, 6, value), CENTRAL, 8, value);
    let method =
        |value| with_header_field(with_header_field(one.clone(), LOCAL, 8, value), CENTRAL, 10, value);
    // System 3 (Unix) with the mode of a named pipe.
    let pipe = with_header_field(
        with_header_field(one.clone(), CENTRAL, 5, &[3]),
        CENTRAL,
        38,
        &(0o010_644_u32 << 16).to_le_bytes(),
    );
    for (bytes, status, at, words) in [
        (b"not a zip".to_vec(), 400, None, "is not a zip archive"),
        (Vec::new(), 400, None, "is not a zip archive"),
        (one[..20].to_vec(), 422, None, "the archive is damaged"),
        (archive_of(&[("../a.png", b"", stored)]), 422, Some("../a.png"), "'..' part"),
        (archive_of(&[("/etc/passwd", b"", stored)]), 422, Some("/etc/passwd"), "absolute"),
        (archive_of(&[("a/../../b", b"", stored)]), 422, Some("a/../../b"), "'..' part"),
        (patched(one.clone(), b"a.png", b"C:png"), 422, Some("C:png"), "drive letter"),
        (patched(two.clone(), b"a.png", b"..\\ng"), 422, Some("../ng"), "'..' part"),
        (patched(one.clone(), b"a.png", b"a\0png"), 422, Some("a\u{fffd}png"), "control characters"),
        (patched(two.clone(), b"b.png", b"a.png"), 422, Some("a.png"), "twice"),
        (link, 422, Some("images"), "is a symbolic link"),
        (pipe, 422, Some("a.png"), "is a special file"),
        (marked(&[1, 0]), 422, Some("a.png"), "encrypted"),
        (method(&[12, 0]), 422, Some("a.png"), "compression method"),
        (archive_of(&[("zeros.bin", &zeros, deflated)]), 413, Some("zeros.bin"), "times its packed size"),
        (with_header_field(two.clone(), CENTRAL, 42, &[0; 4]), 422, None, "overlap"),
    ] {
        let problem = check(&file(&bytes).path).expect_err(words);
        assert_eq!((problem.status, problem.file.as_deref()), (status, at), "{words}: {problem}");
        assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
    }
}

#[test]
fn damaged_entries_are_refused_by_name() {
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let set = nerfstudio();
    let entries: Vec<_> =
        set.0.iter().map(|(name, content)| (name.as_str(), content.as_slice(), stored)).collect();
    let damaged = patched(archive_of(&entries), b"\"fl_x\": 9.0", b"\"fl_x\": 8.0");
    let problem = check(&file(&damaged).path).expect_err("the checksum is wrong");
    assert_eq!((problem.status, problem.file.as_deref()), (422, Some("transforms.json")));
    assert!(problem.detail.contains("damaged"), "{problem}");
}

#[test]
fn limits_are_held_and_name_what_was_over_them() {
    let wide = Limits::default();
    let set = colmap();
    let largest = set.0.values().map(|content| content.len() as u64).max().expect("files");
    for (limits, words) in [
        (Limits { entries: 11, ..wide }, "more than 11 entries"),
        (Limits { file_bytes: largest - 1, ..wide }, "are accepted in one file"),
        (Limits { points: 1, ..wide }, "more than 1 points"),
        (Limits { image_pixels: 47, ..wide }, "the image has 48 pixels; at most 47"),
        (Limits { scene_pixels: 9 * 48 - 1, ..wide }, "the images have 432 pixels together"),
    ] {
        for written in [set.directory(), file(&set.archive())] {
            let problem = Problem::from(check_within(&written.path, &limits).expect_err(words));
            assert_eq!(problem.status, 413, "{problem}");
            assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
        }
    }
    let total: u64 = set.0.values().map(|content| content.len() as u64).sum();
    let archive = file(&set.archive());
    let error = check_within(&archive.path, &Limits { directory_bytes: 100, ..wide }).expect_err("too long");
    assert!(error.to_string().contains("the list of its entries takes"), "{error}");
    let table = nerfstudio();
    let json = table.0["transforms.json"].len() as u64;
    for (json_bytes, fits) in [(json, true), (json - 1, false)] {
        let limits = Limits { json_bytes, ..wide };
        assert_eq!(
            check_within(&table.directory().path, &limits).is_ok(),
            fits,
            "{json_bytes} of {json} bytes"
        );
    }
    let fits = |total_bytes| check_within(&archive.path, &Limits { total_bytes, ..wide }).is_ok();
    assert!(fits(total) && !fits(total - 1));
    let exact = Limits {
        entries: 12,
        file_bytes: largest,
        image_pixels: 48,
        scene_pixels: 9 * 48,
        total_bytes: total,
        points: 2,
        ..wide
    };
    let options =
        SurveyOptions { reading: ReadOptions::default(), decode_bytes: 0, should_continue: &|| true };
    assert!(load_with(&archive.path, &exact, &LoadBudget::default(), &options).is_ok());
}

#[cfg(unix)]
#[test]
fn links_in_a_directory_are_not_followed() {
    use std::os::unix::fs::symlink;
    let elsewhere = colmap().directory();
    let set = colmap().without("images/4.png").directory();
    symlink(elsewhere.path.join("images/4.png"), set.path.join("images/4.png")).expect("a link");
    let problem = check(&set.path).expect_err("a linked image");
    assert_eq!((problem.status, problem.file.as_deref()), (422, Some("images/4.png")));
    assert!(problem.detail.contains("is a symbolic link"), "{problem}");

    let set =
        Set(colmap().0.into_iter().filter(|(name, _)| !name.starts_with("images/")).collect()).directory();
    symlink(elsewhere.path.join("images"), set.path.join("images")).expect("a link");
    symlink(&set.path, set.path.join("loop")).expect("a link to itself");
    let problem = check(&set.path).expect_err("a linked folder");
    assert_eq!(problem.file.as_deref(), Some("images"), "{problem}");
}
