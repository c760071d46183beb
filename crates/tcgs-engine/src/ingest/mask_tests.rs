//! Masks of tiny datasets: found by every name, and read as their photographs are.

use std::{collections::BTreeMap, io::Cursor};

use image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgba, RgbaImage};

use super::{
    LoadBudget, check_as, check_with_cameras, check_within,
    error::IngestError,
    fixtures::{SIZE, Set, blender, colmap, nerfstudio, png},
    limits::Limits,
    load_as,
};
use crate::domain::{Dataset, MaskMode, MaskSource, PixelMask, Problem, ReadOptions};

const WHOLE: &str = "which count whole";

fn read(set: &Set, reading: &ReadOptions) -> Result<Dataset, IngestError> {
    let loaded = load_as(&set.directory().path, reading, &LoadBudget::default(), &|| true);
    let checked = check_as(&set.directory().path, reading);
    if let (Ok(loaded), Ok((summary, _))) = (&loaded, &checked) {
        assert_eq!(loaded.notes, summary.notes, "a check notes what loading does");
    }
    loaded
}

fn loaded(set: &Set) -> Dataset {
    read(set, &ReadOptions::default()).expect("a dataset")
}

fn with_mode(mask_mode: MaskMode) -> ReadOptions {
    ReadOptions { mask_mode, ..ReadOptions::default() }
}

fn encoded(image: impl Into<DynamicImage>) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, ImageFormat::Png).expect("encodes");
    bytes.into_inner()
}

/// A mask whose left half is white.
fn left((width, height): (u32, u32)) -> Vec<u8> {
    encoded(GrayImage::from_fn(width, height, |x, _| Luma([if x < width / 2 { 255 } else { 0 }])))
}

fn left_counts() -> PixelMask {
    PixelMask::from_fn(SIZE.0, SIZE.1, |x, _| x < SIZE.0 / 2)
}

/// The frames with a mask, by name.
fn masks(dataset: &Dataset) -> BTreeMap<&str, &PixelMask> {
    let masked = dataset.frames.iter().filter_map(|frame| Some((frame.name.as_str(), frame.mask.as_ref()?)));
    masked.collect()
}

fn says(dataset: &Dataset, words: &str) {
    assert!(dataset.notes.iter().any(|note| note.contains(words)), "'{words}' in {:?}", dataset.notes);
}

fn refused(set: &Set, reading: &ReadOptions, words: &str) {
    let problem = Problem::from(read(set, reading).expect_err("refused"));
    assert_eq!(problem.status, 422, "{}", problem.detail);
    assert!(problem.detail.contains(words), "'{words}' in '{}'", problem.detail);
}

#[test]
fn masks_of_every_known_name_are_found_and_said() {
    for (mask, place) in [
        ("images/0.png.mask.png", "beside the photographs"),
        ("images/0.mask.png", "beside the photographs"),
        ("images/0_mask.png", "beside the photographs"),
        ("images/mask_0.png", "beside the photographs"),
        ("images/0_sky_mask.png", "beside the photographs"),
        ("images/0.png.png", "beside the photographs"),
        ("masks/0.png", "in masks/"),
        ("mask/0.png", "in mask/"),
        ("masks/0.png.png", "in masks/"),
        ("masks/0_mask.png", "in masks/"),
        ("Masks/0.png", "in Masks/"),
        ("MASKS/0.jpg", "in MASKS/"),
        ("masks_4/0.png", "in masks_4/"),
        ("images/masks/0.png", "in images/masks/"),
        ("colmap/masks/0.png.png", "in colmap/masks/"),
        ("segmentation/0.png", "in segmentation/"),
        ("segmentation/deeper/0.png", "in segmentation/deeper/"),
    ] {
        for set in [nerfstudio(), colmap()] {
            let dataset = loaded(&set.with(mask, left(SIZE)));
            let expected = left_counts();
            let found: Vec<_> = masks(&dataset).into_values().collect();
            assert_eq!(found, [&expected], "{mask}");
            says(
                &dataset,
                &format!("photographs with a mask: 1 ({place}); what is black in them is ignored"),
            );
            says(&dataset, &format!("{WHOLE}: 8"));
            assert!(!dataset.notes.iter().any(|note| note.contains("not used")), "{:?}", dataset.notes);
        }
    }
    let train = loaded(&blender().with("train/r_0_mask.png", left(SIZE)));
    assert_eq!(masks(&train).into_iter().collect::<Vec<_>>(), [("train/r_0", &left_counts())]);
}

#[test]
fn instant_ngps_masks_hide_what_is_white_unless_that_is_half_of_them() {
    let corner = |white: u8, black: u8| {
        encoded(GrayImage::from_fn(SIZE.0, SIZE.1, |x, y| Luma([if x < 2 && y < 2 { white } else { black }])))
    };
    let expected = PixelMask::from_fn(SIZE.0, SIZE.1, |x, y| x >= 2 || y >= 2);
    for (mask, words) in [
        (corner(255, 0), "what is white in them, as in instant-ngp's, is ignored"),
        (corner(0, 255), "what is black in them, as white is half of them or more, is ignored"),
    ] {
        let set = nerfstudio().with("images/dynamic_mask_0.png", mask);
        let dataset = loaded(&set);
        assert_eq!(masks(&dataset).into_values().collect::<Vec<_>>(), [&expected]);
        says(&dataset, words);
        // The check of an upload reads no pixels.
        let notes = check_within(&set.directory().path, &Limits::default()).expect("a dataset").notes;
        assert!(
            notes.iter().any(|note| note.contains("or black if white is half of them or more")),
            "{notes:?}"
        );
    }
}

#[test]
fn masks_that_a_transforms_file_states_are_found() {
    let set = nerfstudio().with("m.png", left(SIZE)).with("other/1.png", left(SIZE));
    for (from, to, count) in [
        ("\"fl_x\"", "\"mask_path\": \"m.png\", \"fl_x\"", 9),
        ("\"fl_x\"", "\"mask_path\": \"./m\", \"fl_x\"", 9),
        ("\"fl_x\"", "\"extra\": {\"mask_path\": \"m.png\"}, \"fl_x\"", 9),
        ("\"fl_x\"", "\"mask_path\": \"other/\", \"fl_x\"", 1),
        (
            "\"file_path\": \"images/1.png\"",
            "\"file_path\": \"images/1.png\", \"mask_path\": \"other/1.png\"",
            1,
        ),
    ] {
        let stating = set.clone().edited("transforms.json", from, to);
        let dataset = loaded(&stating);
        let found = masks(&dataset);
        assert_eq!(found.len(), count, "{to}");
        assert!(found.into_values().all(|mask| *mask == left_counts()));
        says(
            &dataset,
            if count == 1 && to.contains("other/\"") { "(in other/)" } else { "(named in transforms.json)" },
        );
        let none = ReadOptions { masks: MaskSource::None, ..ReadOptions::default() };
        assert!(masks(&read(&stating, &none).expect("a dataset")).is_empty());
    }
    let folder = set.clone().edited("transforms.json", "\"fl_x\"", "\"mask_path\": \"other\", \"fl_x\"");
    assert_eq!(masks(&loaded(&folder)).into_keys().collect::<Vec<_>>(), ["images/1.png"]);
    for (stated, words) in [
        ("\"mask_path\": \"gone.png\"", "/mask_path: the mask 'gone.png' is missing"),
        ("\"masks\": [\"m.png\"]", "/masks: masks are named here, but not by the path"),
        ("\"mask_path\": \"../m.png\"", "'..' part"),
    ] {
        let set = set.clone().edited("transforms.json", "\"fl_x\"", &format!("{stated}, \"fl_x\""));
        refused(&set, &ReadOptions::default(), words);
    }
}

#[test]
fn photographs_in_folders_have_masks_in_folders_of_the_same_names() {
    let listed = colmap().edited("sparse/0/images.txt", " 0.png", " left/0.png").edited(
        "sparse/0/images.txt",
        " 1.png",
        " right/0.png",
    );
    let set =
        listed.with("images/left/0.png", png(SIZE, [1; 4])).with("images/right/0.png", png(SIZE, [1; 4]));
    for mask in
        ["masks/left/0.png.png", "masks/left/0.png", "images/left/masks/0.png", "images/left/0_mask.png"]
    {
        let dataset = loaded(&set.clone().with(mask, left(SIZE)));
        assert_eq!(masks(&dataset).into_keys().collect::<Vec<_>>(), ["left/0.png"], "{mask}");
    }
    refused(
        &set.with("masks/0.png", left(SIZE)),
        &ReadOptions::default(),
        "several photographs have the name",
    );
}

#[test]
fn a_folder_of_masks_is_chosen_by_name_and_none_reads_photographs_whole() {
    let set = colmap()
        .with("people/0.png", left(SIZE))
        .with("cars/0.png", left(SIZE))
        .with("masks/1.png", left(SIZE));
    let of = |masks: &str| ReadOptions { masks: masks.parse().expect("a source"), ..ReadOptions::default() };
    let names = |reading: &ReadOptions| -> Vec<String> {
        let dataset = read(&set, reading).expect("a dataset");
        masks(&dataset).into_keys().map(str::to_owned).collect()
    };
    assert_eq!(names(&of("people/")), ["0.png"]);
    assert_eq!(names(&of("auto")), ["1.png"]);
    assert_eq!(names(&of("none")), [""; 0]);
    refused(&set, &of("nothing"), "there is no image in 'nothing/'");
    let notes = read(&set, &of("none")).expect("a dataset").notes;
    assert!(notes.iter().any(|note| note.contains("in masks/ is not used")), "{notes:?}");
}

#[test]
fn masks_that_belong_to_no_photograph_or_do_not_fit_are_refused() {
    let auto = ReadOptions::default();
    refused(&colmap().with("masks/x.png", left(SIZE)), &auto, "masks/ looks like a folder of masks");
    assert!(
        loaded(&colmap().with("masks/readme.txt", "none")).frames.iter().all(|frame| frame.mask.is_none())
    );
    refused(&colmap().with("masks/0.png", left((8, 8))), &auto, "the mask has (8, 8) pixels");
    let many = (0..5).fold(colmap(), |set, index| set.with(&format!("masks_{index}/0.png"), left(SIZE)));
    refused(&many, &auto, "one mask too many");
    let hidden = encoded(GrayImage::new(SIZE.0, SIZE.1));
    let all = (0..9).fold(colmap(), |set, index| set.with(&format!("masks/{index}.png"), hidden.clone()));
    let problem = Problem::from(
        load_as(&all.directory().path, &auto, &LoadBudget::default(), &|| true)
            .expect_err("nothing to train on"),
    );
    assert!(problem.detail.contains("are black and white swapped?"), "{}", problem.detail);
    let broken = colmap().with("masks/0.png", "no image");
    assert!(
        check_with_cameras(&broken.directory().path)
            .expect_err("no image")
            .file
            .expect("a file")
            .contains("masks/0.png")
    );
}

#[test]
fn a_photograph_that_is_hidden_as_a_whole_is_left_out() {
    let hidden = encoded(GrayImage::new(SIZE.0, SIZE.1));
    let set = colmap().with("masks/3.png", hidden);
    let dataset = load_as(&set.directory().path, &ReadOptions::default(), &LoadBudget::default(), &|| true);
    let dataset = dataset.expect("a dataset");
    assert_eq!(dataset.frames.len(), 8);
    says(&dataset, "of which masks hide every pixel, left out: 1");
}

#[test]
fn masks_of_other_sizes_are_scaled_and_several_of_one_photograph_add_up() {
    let top = encoded(GrayImage::from_fn(SIZE.0, SIZE.1, |_, y| Luma([if y < 3 { 255 } else { 0 }])));
    let set = colmap().with("masks/0.png", left((16, 12))).with("masks_2/0.png", top);
    let dataset = loaded(&set);
    let expected = PixelMask::from_fn(SIZE.0, SIZE.1, |x, y| x < 4 && y < 3);
    assert_eq!(masks(&dataset).into_values().collect::<Vec<_>>(), [&expected]);
}

#[test]
fn a_mask_that_cuts_out_is_the_transparency_of_its_photograph() {
    let set = colmap().with("masks/0.png", left(SIZE));
    let dataset = read(&set, &with_mode(MaskMode::CutOut)).expect("a dataset");
    assert!(masks(&dataset).is_empty());
    let image = dataset.find_frame("0.png").expect("the frame").image.load().expect("in memory");
    let alpha: Vec<u8> = image.samples().chunks_exact(4).map(|pixel| pixel[3]).collect();
    assert_eq!(alpha, [255, 255, 255, 255, 0, 0, 0, 0].repeat(6));
    says(&dataset, "what is black in them is cut out");
}

#[test]
fn transparency_is_cut_out_unless_it_is_to_be_ignored() {
    let half = RgbaImage::from_fn(SIZE.0, SIZE.1, |x, _| Rgba([9, 8, 7, if x < 4 { 255 } else { 100 }]));
    let set = colmap().with("images/0.png", encoded(half));
    let usual = loaded(&set);
    assert!(masks(&usual).is_empty());
    says(&usual, "what is transparent is cut out");
    let ignoring = read(&set, &with_mode(MaskMode::Ignore)).expect("a dataset");
    assert_eq!(masks(&ignoring).into_iter().collect::<Vec<_>>(), [("0.png", &left_counts())]);
    says(&ignoring, "what is transparent is ignored");
    assert_eq!(
        ignoring.find_frame("0.png").expect("the frame").image.load().expect("in memory").channels(),
        3
    );
    // Both hide.
    let top = encoded(GrayImage::from_fn(SIZE.0, SIZE.1, |_, y| Luma([if y < 3 { 255 } else { 0 }])));
    let both = read(&set.with("masks/0.png", top), &with_mode(MaskMode::Ignore)).expect("a dataset");
    let expected = PixelMask::from_fn(SIZE.0, SIZE.1, |x, y| x < 4 && y < 3);
    assert_eq!(masks(&both).into_values().collect::<Vec<_>>(), [&expected]);
}

#[test]
fn masks_go_through_the_lens_with_their_photographs() {
    // Everything that the mask hides is red, so that what counts has no red in it.
    let hidden = |x: u32, y: u32| (20..31).contains(&x) && (9..25).contains(&y);
    let photograph =
        encoded(RgbaImage::from_fn(64, 48, |x, y| Rgba([if hidden(x, y) { 255 } else { 0 }, 90, 30, 255])));
    let mask = encoded(GrayImage::from_fn(64, 48, |x, y| Luma([if hidden(x, y) { 0 } else { 255 }])));
    let set =
        (0..9).fold(colmap(), |set, index| set.with(&format!("images/{index}.png"), photograph.clone()));
    let set =
        set.with("sparse/0/cameras.txt", "1 RADIAL 64 48 60 32 24 -0.08 0.01\n").with("masks/0.png", mask);
    let dataset = loaded(&set);
    let frame = dataset.find_frame("0.png").expect("the frame");
    let (image, mask) = (frame.image.load().expect("in memory"), frame.mask.as_ref().expect("a mask"));
    assert_eq!((mask.width(), mask.height()), (image.width(), image.height()));
    let reds = |counts: bool| {
        let pixels = image.samples().chunks_exact(3).zip(mask.iter());
        pixels.filter(|(_, c)| *c == counts).map(|(pixel, _)| pixel[0]).collect::<Vec<_>>()
    };
    assert!(reds(true).iter().all(|red| *red == 0) && reds(false).iter().all(|red| *red > 0));
    assert!(!reds(false).is_empty());
}

#[test]
fn masks_of_wide_photographs_are_downscaled_with_them() {
    let size = (1920, 12);
    let hidden = |x: u32| (600..900).contains(&x);
    let photograph = encoded(image::RgbImage::from_fn(1920, 12, |x, _| {
        image::Rgb([if hidden(x) { 255 } else { 0 }, 90, 30])
    }));
    let mask = encoded(GrayImage::from_fn(1920, 12, |x, _| Luma([if hidden(x) { 0 } else { 255 }])));
    let set =
        (0..9).fold(colmap(), |set, index| set.with(&format!("images/{index}.png"), photograph.clone()));
    let cameras = format!("1 PINHOLE {} {} 900 900 960 6\n", size.0, size.1);
    let dataset = loaded(&set.with("sparse/0/cameras.txt", cameras).with("masks/0.png", mask));
    let frame = dataset.find_frame("0.png").expect("the frame");
    let (image, mask) = (frame.image.load().expect("in memory"), frame.mask.as_ref().expect("a mask"));
    assert_eq!((mask.width(), image.width()), (1600, 1600));
    let pixels = image.samples().chunks_exact(3).zip(mask.iter());
    assert!(pixels.filter(|(_, counts)| *counts).all(|(pixel, _)| pixel[0] == 0), "no red in what counts");
    let share = mask.counted() as f64 / mask.pixels() as f64;
    assert!((share - 1620.0 / 1920.0).abs() < 0.01, "{share}");
}
