//! The table of training options: the command line, the query string and JSON are read by it.

use std::fmt;

use serde_json::Value;

use super::{
    Background, Component, MAX_CURVE_POINTS, MAX_GAUSSIANS, MAX_ITERATIONS, MAX_SEED, ModelKind, OptionError,
    OptionKind, Preset, TrainOptions,
};
use crate::domain::{CameraModel, ExifOrientation, Exposure, HoldOut, MaskMode, Matching, MaxWidth};

/// A row of [`TRAIN_OPTIONS`].
#[derive(Debug)]
pub struct TrainOption {
    /// Its name in the query string and in JSON; the command line's flag has hyphens for underscores.
    pub name: &'static str,
    /// What it takes.
    pub kind: OptionKind,
    /// What an absent option means, where that is a value.
    pub default: Option<&'static str>,
    /// One sentence for `--help`; none for an earlier name, which the API alone still takes.
    pub help: Option<&'static str>,
    /// `None` where the text is not of this kind.
    set: fn(&mut TrainOptions, &str) -> Option<()>,
}

impl TrainOption {
    /// The option of that name.
    #[must_use]
    pub fn named(name: &str) -> Option<&'static Self> {
        TRAIN_OPTIONS.iter().find(|row| row.name == name)
    }

    /// Sets the option from its text in a query string or after a flag; lists are separated by commas.
    ///
    /// # Errors
    /// [`OptionError`] for a value of another kind.
    pub fn set(&self, options: &mut TrainOptions, text: &str) -> Result<(), OptionError> {
        (self.set)(options, text).ok_or_else(|| self.mismatch(format_args!("'{}'", shown(text))))
    }

    /// Sets the option from its value in JSON: a number, a name, or for a list also an array. `null` leaves an option unset that has
    /// no default.
    ///
    /// # Errors
    /// As [`Self::set`].
    pub fn set_json(&self, options: &mut TrainOptions, value: &Value) -> Result<(), OptionError> {
        match self.kind.text_of(value) {
            Some(text) => self.set(options, &text),
            None if value.is_null() && self.is_nullable() => Ok(()),
            None if value.as_array().is_some_and(Vec::is_empty) && self.kind.is_list() => Ok(()),
            None => Err(self.mismatch(format_args!("{}", shown(&value.to_string())))),
        }
    }

    fn mismatch(&self, value: fmt::Arguments<'_>) -> OptionError {
        OptionError::new(self.name, format!("{value} is not {}", self.kind))
    }

    /// Whether JSON may say `null` for an absent value.
    #[must_use]
    pub fn is_nullable(&self) -> bool {
        self.default.is_none() && !self.kind.is_list()
    }
}

/// Every option of a training run. The command line's flags, the query string and JSON are read by it, and a test holds `openapi.yaml`
/// to it.
pub static TRAIN_OPTIONS: [TrainOption; 25] = [
    TrainOption {
        name: "preset",
        kind: OptionKind::Choice(Preset::NAMES),
        default: Some("preview"),
        help: Some("Schedule: preview for a software adapter, standard for a GPU, paper as published"),
        set: |options, text| text.parse().ok().map(|preset| options.preset = preset),
    },
    TrainOption {
        name: "iterations",
        kind: OptionKind::Integer(1, MAX_ITERATIONS as u64),
        default: None,
        help: Some("Training iterations [default: the preset's]"),
        set: |options, text| text.parse().ok().map(|steps| options.iterations = Some(steps)),
    },
    TrainOption {
        name: "until",
        kind: OptionKind::Choice(&["full"]),
        default: Some("full"),
        help: None,
        set: |options, text| text.parse().ok().map(|until| options.until = until),
    },
    TrainOption {
        name: "seed",
        kind: OptionKind::Integer(0, MAX_SEED),
        default: Some("0"),
        help: Some("Seed of all random numbers"),
        set: |options, text| {
            text.parse().ok().filter(|seed| *seed <= MAX_SEED).map(|seed| options.seed = seed)
        },
    },
    TrainOption {
        name: "background",
        kind: OptionKind::Choice(Background::NAMES),
        default: Some("black"),
        help: Some("Background of renders and of images with alpha"),
        set: |options, text| text.parse().ok().map(|background| options.background = background),
    },
    TrainOption {
        name: "model",
        kind: OptionKind::Choice(ModelKind::NAMES),
        default: Some("tcgs"),
        help: Some("Model to train: tcgs, or one of its baselines"),
        set: |options, text| text.parse().ok().map(|model| options.model = model),
    },
    TrainOption {
        name: "voxel",
        kind: OptionKind::ChoiceOrPositive(&["auto", "published"]),
        default: Some("auto"),
        help: Some(
            "Edge of a voxel of the anchor lattice: auto (from the spacing of the points), published (the paper's rule), or a length in world units",
        ),
        set: |options, text| text.parse().ok().map(|voxel| options.voxel = voxel),
    },
    TrainOption {
        name: "without",
        kind: OptionKind::Choices(Component::NAMES),
        default: None,
        help: Some("Parts of the method to switch off"),
        set: |options, text| {
            names(text).try_for_each(|name| name.parse().ok().map(|part| _ = options.without.insert(part)))
        },
    },
    TrainOption {
        name: "plane_compression",
        kind: OptionKind::Choice(&["auto", "on", "off"]),
        default: Some("auto"),
        help: Some(
            "Down- and upsampling of the context planes: auto switches it on for 30000 iterations and more",
        ),
        set: |options, text| {
            match text {
                "auto" => {}
                "on" => _ = options.with.insert(Component::PlaneCompression),
                "off" => _ = options.without.insert(Component::PlaneCompression),
                _ => return None,
            }
            Some(())
        },
    },
    // As jobs and files store `plane_compression=on`, and earlier clients send it.
    TrainOption {
        name: "with",
        kind: OptionKind::Choices(&["plane-compression"]),
        default: None,
        help: None,
        set: |options, text| {
            names(text).try_for_each(|name| {
                let part = name.parse().ok().filter(|part| *part == Component::PlaneCompression)?;
                options.with.insert(part);
                Some(())
            })
        },
    },
    TrainOption {
        name: "lambda",
        kind: OptionKind::Positive,
        default: None,
        help: Some(
            "Weight of the file's size in the loss; larger makes smaller files [default: the preset's]",
        ),
        set: |options, text| text.parse().ok().map(|weight| options.lambda = Some(weight)),
    },
    TrainOption {
        name: "max_bytes",
        kind: OptionKind::Bytes,
        default: None,
        help: Some("Largest size of the file: coarser quantization and pruning make it fit"),
        set: |options, text| text.parse().ok().map(|bytes| options.max_bytes = Some(bytes)),
    },
    TrainOption {
        name: "target_gaussians",
        kind: OptionKind::Integer(1, MAX_GAUSSIANS as u64),
        default: None,
        help: Some(
            "For the model 3dgs: train more Gaussians, prune them to this number by what the training views lose, train on",
        ),
        set: |options, text| text.parse().ok().map(|number| options.target_gaussians = Some(number)),
    },
    TrainOption {
        name: "max_gaussians",
        kind: OptionKind::Integer(1, MAX_GAUSSIANS as u64),
        default: None,
        help: Some(
            "For the model 3dgs: grow to no more than this number of Gaussians [default: the preset's, or twice the target if more]",
        ),
        set: |options, text| text.parse().ok().map(|number| options.max_gaussians = Some(number)),
    },
    TrainOption {
        name: "rd_curve",
        kind: OptionKind::Positives(MAX_CURVE_POINTS),
        default: None,
        help: Some(
            "Values of lambda, each for a file of its own: training is shared up to where lambda matters",
        ),
        set: |options, text| {
            let list = text.strip_prefix('[').and_then(|list| list.strip_suffix(']')).unwrap_or(text);
            let weights: Option<_> = list.split(',').map(|text| text.trim().parse().ok()).collect();
            weights.map(|weights| options.rd_curve = weights)
        },
    },
    TrainOption {
        name: "exif_orientation",
        kind: OptionKind::Choice(ExifOrientation::NAMES),
        default: Some("auto"),
        help: Some(
            "EXIF orientation of photographs: auto applies it where cameras and points agree with the turned pixels",
        ),
        set: |options, text| text.parse().ok().map(|orientation| options.exif_orientation = orientation),
    },
    TrainOption {
        name: "masks",
        kind: OptionKind::ChoiceOrFolder(&["auto", "none"]),
        default: Some("auto"),
        help: Some("Masks of photographs: auto finds them by their names; none reads photographs whole"),
        set: |options, text| text.parse().ok().map(|masks| options.masks = masks),
    },
    TrainOption {
        name: "mask_mode",
        kind: OptionKind::Choice(MaskMode::NAMES),
        default: Some("auto"),
        help: Some(
            "What masks and transparency mean: auto ignores what masks hide and cuts out what is transparent",
        ),
        set: |options, text| text.parse().ok().map(|mode| options.mask_mode = mode),
    },
    TrainOption {
        name: "skip_missing",
        kind: OptionKind::Switch,
        default: Some("false"),
        help: Some("Leave listed photographs that are missing out, rather than refuse the dataset"),
        set: |options, text| text.parse().ok().map(|skip| options.skip_missing = skip),
    },
    TrainOption {
        name: "holdout",
        kind: OptionKind::Choice(HoldOut::NAMES),
        default: Some("auto"),
        help: Some(
            "Photographs to hold out: auto (the layout's own test views, else every eighth) or a sector of neighboring cameras",
        ),
        set: |options, text| text.parse().ok().map(|holdout| options.holdout = holdout),
    },
    TrainOption {
        name: "max_width",
        kind: OptionKind::Integer(MaxWidth::MIN as u64, MaxWidth::MAX as u64),
        default: Some("1600"),
        help: Some(
            "Width in pixels to which wider photographs are downscaled, for training and held-out views alike",
        ),
        set: |options, text| text.parse().ok().map(|width| options.max_width = width),
    },
    TrainOption {
        name: "exposure",
        kind: OptionKind::Choice(Exposure::NAMES),
        default: Some("auto"),
        help: Some(
            "Learn a color correction for each photograph: auto does if training views that are set aside gain by it",
        ),
        set: |options, text| text.parse().ok().map(|exposure| options.exposure = exposure),
    },
    TrainOption {
        name: "crop",
        kind: OptionKind::ChoiceOrBox(&["none", "cameras"]),
        default: Some("none"),
        help: Some(
            "Keep a part of the finished scene: what at least half of the training cameras have in view (cameras), or a box x0,y0,z0,x1,y1,z1 in the dataset's world",
        ),
        set: |options, text| text.parse().ok().map(|crop| options.crop = crop),
    },
    TrainOption {
        name: "camera_model",
        kind: OptionKind::Choice(CameraModel::NAMES),
        default: Some("simple-radial"),
        help: Some(
            "COLMAP's model of cameras that are found first, of photographs without them; other datasets state theirs",
        ),
        set: |options, text| text.parse().ok().map(|model| options.camera_model = model),
    },
    TrainOption {
        name: "matching",
        kind: OptionKind::Choice(Matching::NAMES),
        default: Some("auto"),
        help: Some(
            "Photographs without cameras that are compared to find them: exhaustive (all pairs), sequential (neighbors by name), auto (all pairs of up to 200)",
        ),
        set: |options, text| text.parse().ok().map(|matching| options.matching = matching),
    },
];

/// As much of a value as a message repeats.
fn shown(value: &str) -> String {
    value.chars().take(100).collect()
}

/// The names of a list.
fn names(text: &str) -> impl Iterator<Item = &str> {
    text.split(',').filter(|name| !name.is_empty())
}
