//! Datasets as people send them: in other folders, with other paths, or without a part.

use super::{
    fixtures::{SIZE, Set, blender, colmap, file, nerfstudio, png},
    *,
};
use crate::domain::{Layout, Split};

fn loaded(set: &Set) -> Dataset {
    let (folder, archive) = (set.directory(), file(&set.archive()));
    let dataset = load(&folder.path).expect("a dataset");
    let zipped = load(&archive.path).expect("a dataset");
    assert_eq!((zipped.digest, &zipped.notes), (dataset.digest, &dataset.notes));
    let checked = check(&folder.path).expect("a dataset");
    assert_eq!(checked.notes, dataset.notes, "a check notes what loading does");
    dataset
}

#[track_caller]
fn refused(set: &Set, words: &str) {
    for written in [set.directory(), file(&set.archive())] {
        let problem = check(&written.path).expect_err("must be refused");
        assert_eq!(problem.status, 422, "{problem}");
        assert!(problem.detail.contains(words), "'{}' should say '{words}'", problem.detail);
    }
}

fn names(dataset: &Dataset, split: Split) -> Vec<&str> {
    dataset.split(split).map(|frame| frame.name.as_str()).collect()
}

/// A set with files renamed.
fn renamed(set: Set, from: &str, to: &str) -> Set {
    Set(set.0.into_iter().map(|(name, content)| (name.replacen(from, to, 1), content)).collect())
}

/// A set with one passage of a text replaced wherever it stands.
fn replaced(set: Set, name: &str, from: &str, to: &str) -> Set {
    let text = String::from_utf8(set.0[name].clone()).expect("text");
    assert!(text.contains(from), "{name} has no '{from}'");
    set.with(name, text.replace(from, to))
}

fn merged(sets: impl IntoIterator<Item = Set>) -> Set {
    Set(sets.into_iter().flat_map(|set| set.0).collect())
}

#[test]
fn a_dataset_is_found_at_any_depth_and_beside_other_files() {
    for set in [blender(), nerfstudio(), colmap()] {
        let plain = loaded(&set);
        for folder in ["dense/0", "a b/c/d", "train"] {
            let nested = loaded(&set.clone().inside(folder));
            assert_eq!((nested.digest, &nested.notes), (plain.digest, &plain.notes), "{folder}");
            let beside =
                loaded(&set.clone().inside(folder).with("README.md", "hello").with("database.db", ""));
            assert_eq!(beside.digest, plain.digest, "{folder}");
            let note = format!("the dataset is in {folder}/; not used: README.md, database.db");
            assert!(beside.notes.contains(&note), "{:?}", beside.notes);
        }
        let litter = set.clone().inside("my set").with("__MACOSX/my set/._a", "").with("README.md", "");
        assert_eq!(loaded(&litter).digest, plain.digest);
    }
}

#[test]
fn a_dataset_inside_of_anothers_folder_belongs_to_it() {
    let set = merged([colmap(), colmap().inside("distorted"), nerfstudio().inside("backup")]);
    assert_eq!(loaded(&set).digest, loaded(&colmap()).digest);
    assert_eq!(loaded(&set.inside("deep/er")).digest, loaded(&colmap()).digest);
}

#[test]
fn several_datasets_are_refused_with_their_folders() {
    refused(
        &merged([colmap().inside("a"), nerfstudio().inside("b/c")]),
        "there are 2 datasets, in a/, b/c/:",
    );
    let many = merged((0..9).map(|index| colmap().inside(&format!("scan{index}"))));
    refused(&many, "there are 9 datasets, in scan0/, scan1/, scan2/, scan3/ and 5 more: send one of them");
}

#[test]
fn tables_beside_photographs_are_a_dataset() {
    let plain = loaded(&colmap());
    let same_frames = |set: &Set| {
        let dataset = loaded(set);
        assert_eq!(dataset.layout, Layout::Colmap);
        assert_eq!(names(&dataset, Split::Train), names(&plain, Split::Train));
        assert_eq!(dataset.points.map(|points| points.positions.len()), Some(2));
        assert!(dataset.notes.is_empty(), "{:?}", dataset.notes);
    };
    let at_top = renamed(colmap(), "sparse/0/", "");
    let flat = renamed(at_top.clone(), "images/", "");
    let in_model = renamed(colmap(), "sparse/0/", "model/");
    for set in [at_top, flat, in_model] {
        same_frames(&set);
        same_frames(&set.inside("export/site 4"));
    }
    // A file of another program is no table of COLMAP.
    refused(&Set::default().with("cameras.txt", "x").with("images/0.png", png(SIZE, [0; 4])), "no dataset");
}

#[test]
fn paths_of_another_machine_are_found_by_name() {
    let plain = loaded(&nerfstudio());
    for folder in [
        r"C:\\Users\\x\\images",
        "/home/x/set/images",
        "../../set/images",
        r"\\\\nas\\set\\images",
        "data/images",
    ] {
        let set = replaced(nerfstudio(), "transforms.json", "images/", &format!("{folder}/"));
        let dataset = loaded(&set);
        assert_eq!(names(&dataset, Split::Train), names(&plain, Split::Train), "{folder}");
        let note = "9 photographs of transforms.json are not where it says, and found by name: '";
        assert!(
            dataset.notes.iter().any(|text| text.starts_with(note) && text.ends_with("' is images/0.png")),
            "{:?}",
            dataset.notes
        );
    }
    for listed in ["/home/x/images/", r"D:\set\", "frames/"] {
        let set = replaced(colmap(), "sparse/0/images.txt", " 0.25 4 1 ", &format!(" 0.25 4 1 {listed}"));
        let dataset = loaded(&set);
        assert_eq!(names(&dataset, Split::Test), ["0.png", "8.png"], "{listed}");
        assert!(dataset.notes[0].contains("9 photographs of sparse/0/images.txt"), "{:?}", dataset.notes);
    }
    // Photographs under another folder's name.
    let dataset = loaded(&renamed(colmap(), "images/", "input/"));
    assert_eq!(names(&dataset, Split::Test), ["input/0.png", "input/8.png"]);
}

#[test]
fn split_lists_with_paths_of_another_machine_are_honored() {
    let foreign = replaced(nerfstudio(), "transforms.json", "images/", "/home/x/images/");
    let list = r#""test_filenames": ["/home/x/images/3.png"], "frames""#;
    let dataset = loaded(&foreign.edited("transforms.json", "\"frames\"", list));
    assert_eq!(names(&dataset, Split::Test), ["images/3.png"]);
}

#[test]
fn the_folder_that_agrees_longest_is_used_and_nothing_is_guessed() {
    let foreign = replaced(nerfstudio(), "transforms.json", "images/", "/home/x/images/");
    let copies = |set: &Set, folder: &str| {
        let images = set.0.iter().filter(|(name, _)| name.starts_with("images/"));
        Set(images
            .map(|(name, _)| (name.replacen("images", folder, 1), png((4, 3), [1, 2, 3, 255])))
            .collect())
    };
    for other in ["depth", "images_2", "previews/small"] {
        let dataset = loaded(&merged([foreign.clone(), copies(&foreign, other)]));
        assert!(dataset.find_frame("images/3.png").is_some(), "{other}");
    }
    let moved = renamed(foreign.clone(), "images/", "photos/");
    assert!(loaded(&merged([moved.clone(), copies(&foreign, "depth")])).find_frame("photos/3.png").is_some());
    let two = merged([moved, copies(&foreign, "previews")]);
    refused(&two, "9 of the 9 images listed here are missing: /home/x/images/0.png");
    refused(&two, "there are 2 images called '0.png', and nothing tells which is meant");
    // A photograph that is deleted from its folder is not looked for in others.
    let deleted = nerfstudio().without("images/4.png").with("other/4.png", png(SIZE, [0; 4]));
    refused(&deleted, "1 of the 9 images listed here are missing: images/4.png");
    // Cameras of a rig have folders of their own with the same names.
    let rig = replaced(nerfstudio(), "transforms.json", "images/1.png", "/home/x/left/0.png");
    let rig = replaced(rig, "transforms.json", "images/2.png", "/home/x/right/0.png");
    let rig = renamed(renamed(rig, "images/1.png", "left/0.png"), "images/2.png", "right/0.png");
    let dataset = loaded(&rig);
    assert!(dataset.find_frame("left/0.png").is_some() && dataset.find_frame("right/0.png").is_some());
}

#[test]
fn test_poses_without_pictures_are_not_held_out() {
    let set = blender().without("test/r_0.png");
    let validated = loaded(&set);
    assert_eq!(names(&validated, Split::Test), ["val/r_0"]);
    let note =
        "none of the 1 photographs of transforms_test.json is there: transforms_val.json is held out instead";
    assert!(validated.notes.iter().any(|found| found == note), "{:?}", validated.notes);
    let alone = loaded(&set.clone().without("transforms_val.json"));
    assert_eq!(
        (names(&alone, Split::Test), names(&alone, Split::Train)),
        (vec!["train/r_0"], vec!["train/r_1"])
    );
    let neither = loaded(&set.without("val/r_0.png"));
    assert_eq!(names(&neither, Split::Test), ["train/r_0"]);
    assert!(
        neither.notes.iter().any(|note| note.contains("of transforms_val.json is there")),
        "{:?}",
        neither.notes
    );
    // Paths of another machine do not make training pictures those of the test poses.
    let foreign =
        replaced(blender().without("test/r_0.png"), "transforms_train.json", "./train/", "/x/train/");
    let foreign =
        replaced(foreign, "transforms_test.json", "./test/", "/x/test/").without("transforms_val.json");
    assert_eq!(names(&loaded(&foreign), Split::Train), ["train/r_1"]);
    // Some pictures of a test split are no such thing.
    let two = replaced(
        blender(),
        "transforms_test.json",
        "\"frames\": [",
        "\"frames\": [{\"file_path\": \"test/r_9\", \
        \"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},",
    );
    refused(&two, "1 of the 2 images listed here are missing: test/r_9");
}

#[test]
fn a_uniform_scale_of_rotations_is_taken_out() {
    let plain = loaded(&nerfstudio());
    for scale in ["0.01", "100", "1.001"] {
        let axes = format!("[[{scale},0,0,0.5],[0,{scale},0,0.25],[0,0,{scale},4],[0,0,0,1]]");
        let set = replaced(
            nerfstudio(),
            "transforms.json",
            "[[1,0,0,0.5],[0,1,0,0.25],[0,0,1,4],[0,0,0,1]]",
            &axes,
        );
        let dataset = loaded(&set);
        for (frame, plain) in dataset.frames.iter().zip(&plain.frames) {
            assert_eq!(frame.camera, plain.camera, "{scale}");
        }
        let note = "the rotations of 9 poses of transforms.json have a scale, which is taken out: ";
        assert!(dataset.notes.iter().any(|text| text.starts_with(note)), "{:?}", dataset.notes);
    }
    for axes in [
        "[[0.01,0,0,0.5],[0,0.01,0,0.25],[0,0,-0.01,4],[0,0,0,1]]",
        "[[0.01,0,0,0.5],[0,0.02,0,0.25],[0,0,0.01,4],[0,0,0,1]]",
        "[[0,0,0,0.5],[0,0,0,0.25],[0,0,0,4],[0,0,0,1]]",
        "[[1e-300,0,0,0.5],[0,1e-300,0,0.25],[0,0,1e-300,4],[0,0,0,1]]",
    ] {
        let set =
            nerfstudio().edited("transforms.json", "[[1,0,0,0.5],[0,1,0,0.25],[0,0,1,4],[0,0,0,1]]", axes);
        refused(&set, "/frames/0/transform_matrix: the pose is not rigid");
    }
}

#[test]
fn photographs_of_a_format_that_is_not_read_are_refused_by_name() {
    let heic = b"\0\0\0\x24ftypheic\0\0\0\0mif1heic".as_slice();
    for (head, extension, words) in [
        (
            &b"II*\0\x08\0\0\0\0\0"[..],
            "tif",
            "is a TIFF image, which is not read; convert the photographs to PNG or JPEG (`mogrify -format png *.tif`)",
        ),
        (b"\0\0\0\x1cftypavif\0\0\0\0", "avif", "is an AVIF image, which is not read"),
        (heic, "HEIC", "(`mogrify -format jpg *.HEIC`). Tables may keep the old names"),
        (heic, "jpg", "is a HEIC image, which is not read"),
    ] {
        let name = format!("4.{extension}");
        let listed = replaced(colmap(), "sparse/0/images.txt", "4 1 4.png", &format!("4 1 {name}"));
        let set = listed.without("images/4.png").with(&format!("images/{name}"), head);
        refused(&set, words);
        if extension != "jpg" {
            // As the advice says.
            let dataset = loaded(&set.with("images/4.jpg", png(SIZE, [1, 2, 3, 255])));
            assert!(dataset.find_frame(&name).is_some());
            assert!(
                dataset.notes.iter().any(|note| note == &format!("not used: images/{name}")),
                "{:?}",
                dataset.notes
            );
        }
    }
    let set = colmap().without("images/4.png").with("images/4.heic", heic);
    refused(
        &set,
        "there is 'images/4.heic', which is HEIC: convert it to PNG or JPEG, `mogrify -format jpg *.heic`",
    );
    refused(&Set::default().with("IMG_1.heic", heic), "is a HEIC image, which is not read");
}

#[test]
fn missing_photographs_are_left_out_if_that_is_asked_for() {
    let skip = ReadOptions { skip_missing: true, ..ReadOptions::default() };
    let split = r#""test_filenames": ["images/3.png", "images/4.png"], "frames""#;
    let lists = nerfstudio().edited("transforms.json", "\"frames\"", split);
    for (set, listing) in
        [(colmap(), "sparse/0/images.txt"), (nerfstudio(), "transforms.json"), (lists, "transforms.json")]
    {
        let set = set.without("images/4.png").without("images/5.png");
        refused(
            &set,
            "2 of the 9 images listed here are missing: images/4.png, images/5.png. To go on without them, set skip_missing=true (--skip-missing)",
        );
        let folder = set.directory();
        let dataset = load_as(&folder.path, &skip, &LoadBudget::default(), &|| true).expect("a dataset");
        assert_eq!(dataset.frames.len(), 7);
        let note = format!(
            "2 of the 9 photographs of {listing} are missing and left out: images/4.png, images/5.png"
        );
        assert!(dataset.notes.contains(&note), "{:?}", dataset.notes);
        let (summary, cameras) = check_as(&folder.path, &skip).expect("a dataset");
        assert_eq!((summary.train + summary.test, cameras.len(), summary.notes), (7, 7, dataset.notes));
    }
    // Not a dataset without any.
    let none = Set(colmap().0.into_iter().filter(|(name, _)| !name.starts_with("images/")).collect());
    assert!(check_as(&none.directory().path, &skip).is_err());
    let whole = colmap().directory();
    assert_eq!(check_as(&whole.path, &skip), check_with_cameras(&whole.path));
}

#[test]
fn fisheye_photographs_are_undistorted() {
    let ns = |from: &str, to: &str| nerfstudio().edited("transforms.json", from, to);
    let model = |model: &str| ns("\"OPENCV\"", model);
    let prisms = r#""FISHEYE624", "distortion_params": [0.1,0,0,0,0,0,0,0,0,0,0,0]"#;
    let colmap = |model: &str| colmap().edited("sparse/0/cameras.txt", "PINHOLE 8 6 9 9.5 4.25 3", model);
    for set in [
        model("\"OPENCV_FISHEYE\""),
        model("\"OPENCV\", \"is_fisheye\": true"),
        ns("\"camera_model\": \"OPENCV\"", "\"is_fisheye\": true"),
        model(prisms),
        colmap("OPENCV_FISHEYE 8 6 9 9.5 4.25 3 0.1 0 0 0"),
        colmap("THIN_PRISM_FISHEYE 8 6 9 9.5 4.25 3 0.1 0 0 0 0 0 0 0"),
        colmap("FISHEYE 8 6 9 9.5 4.25 3"),
        colmap("EUCM 8 6 9 9.5 4.25 3 0.5 1"),
    ] {
        let dataset = loaded(&set);
        assert!(
            dataset.notes.iter().any(|note| note.starts_with("images undistorted: 9")),
            "{:?}",
            dataset.notes
        );
        assert_eq!(dataset.frames[1].camera.intrinsics.fx, 9.0, "the stated focal length");
    }
    refused(&model("\"OPENCV_FISHEYE\", \"k2\": -1e6"), "less than half");
}

#[test]
fn borders_that_a_lens_did_not_see_are_masked_where_a_crop_would_lose_much() {
    let set = colmap().edited(
        "sparse/0/cameras.txt",
        "PINHOLE 8 6 9 9.5 4.25 3",
        "FULL_OPENCV 8 6 9 9.5 4.25 3 0.9 0 0 0 0 0 0 1e-9",
    );
    let dataset = loaded(&set);
    for frame in &dataset.frames {
        let mask = frame.mask.as_ref().expect("a mask");
        assert_eq!((mask.width(), mask.height(), frame.image.width()), (8, 6, 8));
        assert!(!mask.counts(0) && mask.counts(27) && mask.counted() > 12, "{mask:?}");
    }
    assert!(
        dataset.notes.contains(
            &"images with borders that the lens did not see: 9; these are neither learnt nor measured"
                .to_owned()
        ),
        "{:?}",
        dataset.notes
    );
    assert!(loaded(&colmap()).frames.iter().all(|frame| frame.mask.is_none()));
}
