use serde_json::json;

use super::*;

fn set_option(options: &mut TrainOptions, name: &str, text: &str) -> Result<(), OptionError> {
    TrainOption::named(name).expect("an option").set(options, text)
}

/// The options that are set by these names and values, checked.
fn validated(pairs: &[(&str, &str)]) -> Result<TrainOptions, OptionError> {
    let mut options = TrainOptions::default();
    pairs.iter().for_each(|(name, value)| set_option(&mut options, name, value).expect("parses"));
    options.validated()
}

#[test]
fn options_are_set_by_name_and_faults_name_the_option() {
    let mut options = TrainOptions::default();
    set_option(&mut options, "preset", "standard").expect("a preset");
    set_option(&mut options, "iterations", "1500").expect("a number");
    set_option(&mut options, "background", "white").expect("a background");
    assert_eq!(options.preset, Preset::Standard);
    assert_eq!(options.iterations, Some(1500));
    let error = set_option(&mut options, "preset", "fast").expect_err("no such preset");
    assert_eq!(error.to_string(), "preset: 'fast' is not one of preview, standard, paper");
    assert!(set_option(&mut options, "seed", "-1").is_err());
    assert!(TrainOption::named("color").is_none());
}

#[test]
fn every_field_has_its_row_with_its_default() {
    let with = Component::ALL.iter().copied().collect();
    let exif_orientation = ExifOrientation::Ignore;
    let (masks, mask_mode) = (MaskSource::None, MaskMode::Ignore);
    let stated = TrainOptions {
        exif_orientation,
        masks,
        mask_mode,
        skip_missing: true,
        holdout: HoldOut::Sector,
        max_width: MaxWidth::new(400).expect("a width"),
        target_gaussians: Some(1),
        max_gaussians: Some(1),
        exposure: Exposure::On,
        crop: Crop::Cameras,
        camera_model: CameraModel::Opencv,
        matching: Matching::Exhaustive,
        ..TrainOptions::default()
    };
    let all = TrainOptions { with, until: Until::Converged, ..stated };
    let fields = serde_json::to_value(all).expect("JSON");
    let fields: BTreeSet<&str> = fields.as_object().expect("an object").keys().map(String::as_str).collect();
    let rows = TRAIN_OPTIONS.iter().map(|row| row.name).filter(|name| *name != "plane_compression");
    assert_eq!(fields, rows.collect());
    for row in &TRAIN_OPTIONS {
        let mut options = TrainOptions::default();
        row.default.into_iter().for_each(|text| row.set(&mut options, text).expect("a value"));
        assert_eq!(options, TrainOptions::default(), "{}", row.name);
        let error = row.set(&mut options, "?").expect_err("no value");
        assert_eq!(error.to_string(), format!("{}: '?' is not {}", row.name, row.kind));
    }
}

#[test]
fn json_has_numbers_names_and_lists_of_them() {
    let set = |name: &str, value: serde_json::Value| {
        let mut options = TrainOptions::default();
        TrainOption::named(name).expect("an option").set_json(&mut options, &value).map(|()| options)
    };
    let with_lists = set("without", json!(["masks", "knn"])).expect("parts");
    assert_eq!(with_lists.without, [Component::Knn, Component::Masks].into());
    assert_eq!(set("rd_curve", json!([0.004, 1e-3])).expect("weights").rd_curve, [0.004, 0.001]);
    assert_eq!(set("rd_curve", json!("0.004,1e-3")).expect("weights").rd_curve, [0.004, 0.001]);
    assert_eq!(set("voxel", json!(0.1)).expect("a length").voxel, Voxel::Edge(0.1));
    for (name, value) in [("lambda", json!(null)), ("without", json!([])), ("rd_curve", json!([]))] {
        assert_eq!(set(name, value).expect("absent"), TrainOptions::default());
    }
    for (name, value) in [
        ("iterations", json!("7")),
        ("iterations", json!(1.5)),
        ("seed", json!(null)),
        ("voxel", json!("0.5")),
        ("lambda", json!(true)),
        ("without", json!(null)),
        ("without", json!(["masks,knn"])),
        ("without", json!([""])),
        ("rd_curve", json!(["0.1"])),
        ("rd_curve", json!(0.1)),
    ] {
        let error = set(name, value.clone()).expect_err("another kind");
        assert!(error.option == name && error.error.contains(&value.to_string()), "{name}: {error}");
    }
}

#[test]
fn compressed_planes_are_automatic_on_or_off() {
    let set = |text: &str| {
        let mut options = TrainOptions::default();
        set_option(&mut options, "plane_compression", text).map(|()| options)
    };
    assert_eq!(set("auto"), Ok(TrainOptions::default()));
    assert_eq!(set("on").expect("on").with, [Component::PlaneCompression].into());
    assert!(!set("off").expect("off").has(Component::PlaneCompression));
    let mut both = set("on").expect("on");
    set_option(&mut both, "without", "plane-compression").expect("a part");
    assert_eq!(both.validated().expect_err("a contradiction").option, "plane_compression");
}

#[test]
fn a_part_is_on_in_the_method_and_off_in_the_baselines_and_where_it_is_left_out() {
    let mut options = TrainOptions::default();
    assert!(options.has(Component::Wavelet));
    set_option(&mut options, "without", "wavelet").expect("a part");
    let options = options.validated().expect("this version has it");
    assert!(!options.has(Component::Wavelet) && options.has(Component::Masks));
    for model in [ModelKind::Scaffold, ModelKind::Gaussians3d] {
        let baseline = TrainOptions { model, ..TrainOptions::default() };
        assert!(!baseline.has(Component::Wavelet));
    }
}

#[test]
fn options_that_a_model_has_no_use_for_are_refused() {
    for (pairs, option) in [
        ([("model", "3dgs"), ("voxel", "0.1")], "voxel"),
        ([("model", "3dgs"), ("voxel", "published")], "voxel"),
        ([("model", "3dgs"), ("without", "masks")], "without"),
        ([("model", "scaffold"), ("without", "knn")], "without"),
    ] {
        assert_eq!(validated(&pairs).expect_err("of no use").option, option, "{pairs:?}");
    }
    for pairs in [
        [("model", "scaffold"), ("voxel", "0.1")],
        [("model", "3dgs"), ("voxel", "auto")],
        [("model", "3dgs"), ("plane_compression", "off")],
    ] {
        assert!(validated(&pairs).is_ok(), "{pairs:?}");
    }
}

#[test]
fn runs_that_earlier_versions_could_end_early_are_read_and_new_ones_are_refused_with_the_reason() {
    let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
    assert!(usual.get("until").is_none());
    let stored = json!({ "until": "converged" });
    let options: TrainOptions = serde_json::from_value(stored).expect("stored options");
    assert_eq!(serde_json::to_value(&options).expect("JSON")["until"], "converged");
    let error = validated(&[("until", "converged")]).expect_err("no longer a choice");
    assert!(error.option == "until" && error.error.contains("iterations"), "{error}");
    assert_eq!(validated(&[("until", "full")]), Ok(TrainOptions::default()));
    let error = set_option(&mut TrainOptions::default(), "until", "soon").expect_err("no choice");
    assert_eq!(error.to_string(), "until: 'soon' is not one of full");
}

#[test]
fn only_parts_that_are_off_by_default_can_be_switched_on() {
    let asked = |model, without: &[Component], with: &str| {
        let without = without.iter().copied().collect();
        let mut options = TrainOptions { model, without, ..TrainOptions::default() };
        set_option(&mut options, "with", with)?;
        options.validated()
    };
    let options = asked(ModelKind::Tcgs, &[], "plane-compression").expect("possible");
    assert_eq!(serde_json::to_value(&options).expect("JSON")["with"], json!(["plane-compression"]));
    let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
    assert!(usual.get("with").is_none(), "it is not serialized unless set");
    for (error, option) in [
        (asked(ModelKind::Tcgs, &[], "masks"), "with"),
        (asked(ModelKind::Tcgs, &[], "hope"), "with"),
        (asked(ModelKind::Tcgs, &[Component::PlaneCompression], "plane-compression"), "plane_compression"),
        (asked(ModelKind::Tcgs, &[Component::TriPlane], "plane-compression"), "plane_compression"),
        (asked(ModelKind::Scaffold, &[], "plane-compression"), "plane_compression"),
    ] {
        assert_eq!(error.expect_err("refused").option, option);
    }
    let stored: TrainOptions = serde_json::from_value(json!({ "with": ["masks"] })).expect("options");
    assert_eq!(stored.validated().expect_err("refused").option, "plane_compression");
}

#[test]
fn a_voxel_is_a_rule_or_a_length_in_every_form() {
    for (text, voxel, json) in [
        ("auto", Voxel::Auto, "\"auto\""),
        ("published", Voxel::Published, "\"published\""),
        ("0.025", Voxel::Edge(0.025), "0.025"),
    ] {
        assert_eq!(text.parse(), Ok(voxel));
        assert_eq!(voxel.to_string(), text);
        assert_eq!(serde_json::to_string(&voxel).expect("JSON"), json);
        assert_eq!(serde_json::from_str::<Voxel>(json).expect("a voxel"), voxel);
        let options = TrainOptions { voxel, ..TrainOptions::default() };
        assert_eq!(options.clone().validated(), Ok(options));
    }
    for text in ["", "small", "0,1"] {
        assert_eq!(set_option(&mut TrainOptions::default(), "voxel", text).expect_err(text).option, "voxel");
    }
    for edge in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-300, 1e300] {
        let options = TrainOptions { voxel: Voxel::Edge(edge), ..TrainOptions::default() };
        assert_eq!(options.validated().expect_err("no length").option, "voxel", "{edge}");
    }
}

#[test]
fn a_region_is_checked_with_the_options() {
    let crop = validated(&[("crop", "-1,-1,-1,1,1,1")]).expect("possible").crop;
    assert_eq!(crop, Crop::Box([-1.0; 3], [1.0; 3]));
    for wrong in ["1,1,1,-1,-1,-1", "0,0,0,1,1,nan"] {
        assert_eq!(validated(&[("crop", wrong)]).expect_err(wrong).option, "crop");
    }
    let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
    for option in ["crop", "camera_model", "matching"] {
        assert!(usual.get(option).is_none(), "{option}");
    }
}

#[test]
fn a_target_size_is_for_the_method_alone() {
    assert_eq!(validated(&[("max_bytes", "50000")]).expect("possible").max_bytes, Some(50_000));
    for wrong in [
        &[("max_bytes", "50000"), ("model", "scaffold")][..],
        &[("max_bytes", "50000"), ("model", "3dgs")],
        &[("max_bytes", "50000"), ("rd_curve", "0.001")],
    ] {
        assert_eq!(validated(wrong).expect_err("impossible").option, "max_bytes", "{wrong:?}");
    }
    for text in ["-1", "1e6", "5 MB", ""] {
        let error = set_option(&mut TrainOptions::default(), "max_bytes", text).expect_err(text);
        assert_eq!(error.option, "max_bytes");
    }
}

#[test]
fn numbers_of_gaussians_are_for_plain_gaussians_alone() {
    let plain = ("model", "3dgs");
    let both =
        validated(&[plain, ("target_gaussians", "1000"), ("max_gaussians", "9000")]).expect("possible");
    assert_eq!((both.target_gaussians, both.max_gaussians), (Some(1000), Some(9000)));
    let json = serde_json::to_value(&both).expect("JSON");
    assert_eq!((&json["target_gaussians"], &json["max_gaussians"]), (&json!(1000), &json!(9000)));
    let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
    assert!(usual.get("target_gaussians").is_none() && usual.get("max_gaussians").is_none());
    for option in ["target_gaussians", "max_gaussians"] {
        for wrong in [&[(option, "0"), plain][..], &[(option, "100000001"), plain], &[(option, "1000")]] {
            assert_eq!(validated(wrong).expect_err("impossible").option, option, "{wrong:?}");
        }
    }
    let more = validated(&[plain, ("target_gaussians", "1000"), ("max_gaussians", "999")]);
    assert_eq!(more.expect_err("impossible").option, "target_gaussians");
}

#[test]
fn a_curve_is_a_list_of_distinct_weights_in_the_order_given() {
    let curve = |text: &str| {
        let mut options = TrainOptions::default();
        set_option(&mut options, "rd_curve", text).and_then(|()| options.validated())
    };
    for text in ["0.004,0.0005,0.001", "[0.004, 0.0005, 1e-3]"] {
        let options = curve(text).expect("possible");
        assert_eq!(options.rd_curve, [0.004, 0.0005, 0.001]);
        let json = serde_json::to_string(&options).expect("JSON");
        assert_eq!(serde_json::from_str::<TrainOptions>(&json).expect("options"), options);
        let branches = options.branches();
        let lambdas: Vec<_> = branches.iter().map(|branch| branch.lambda).collect();
        assert_eq!(lambdas, [Some(0.004), Some(0.0005), Some(0.001)]);
        assert!(branches.iter().all(|branch| branch.rd_curve.is_empty()));
    }
    assert_eq!(TrainOptions::default().branches(), [TrainOptions::default()]);
    let nine: Vec<String> = (1..=9).map(|weight| weight.to_string()).collect();
    assert!(curve(&nine[..8].join(",")).is_ok());
    for wrong in
        ["", "0.001,", "[0.001", "0", "-1", "nan", "inf", "1e-3,1e39", "0.001,1e-3", "many", &nine.join(",")]
    {
        assert_eq!(curve(wrong).expect_err(wrong).option, "rd_curve", "{wrong}");
    }
    let rd_curve = vec![0.001];
    for wrong in [
        TrainOptions { lambda: Some(0.1), rd_curve: rd_curve.clone(), ..TrainOptions::default() },
        TrainOptions { model: ModelKind::Scaffold, rd_curve, ..TrainOptions::default() },
    ] {
        assert!(wrong.validated().is_err());
    }
}

#[test]
fn the_weight_of_the_rate_is_positive_and_the_methods_own() {
    for lambda in [1e-6, 0.001, 40.0] {
        let options = TrainOptions { lambda: Some(lambda), ..TrainOptions::default() };
        assert_eq!(options.clone().validated(), Ok(options.clone()));
        for model in [ModelKind::Scaffold, ModelKind::Gaussians3d] {
            let baseline = TrainOptions { model, ..options.clone() };
            assert_eq!(baseline.validated().expect_err("no rate term").option, "lambda");
        }
    }
    for lambda in [0.0, -0.001, f64::NAN, f64::INFINITY, 1e-300] {
        let options = TrainOptions { lambda: Some(lambda), ..TrainOptions::default() };
        assert_eq!(options.validated().expect_err("no weight").option, "lambda", "{lambda}");
    }
}

#[test]
fn what_this_version_cannot_do_is_refused_not_ignored() {
    let mut options = TrainOptions::default();
    let parts: Vec<&str> = Component::ALL.iter().map(|part| part.name()).collect();
    set_option(&mut options, "without", &parts.join(",")).expect("parses");
    let options = options.validated().expect("every part can be left out");
    assert!(Component::ALL.iter().all(|part| !options.has(*part)));
    let zero = TrainOptions { iterations: Some(0), ..TrainOptions::default() };
    assert!(zero.validated().is_err());
}
