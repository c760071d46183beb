//! The flags for what may be read in more than one way, as commands that read a dataset take them.

use clap::builder::{PossibleValuesParser, TypedValueParser as _};
use tcgs::{
    codec::inspect,
    domain::{ExifOrientation, HoldOut, MaskMode, MaskSource, MaxWidth, ReadOptions, TrainOptions},
};

/// How the files of a dataset are read.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct ReadFlags {
    /// EXIF orientation of photographs: auto applies it where cameras and points agree with the turned pixels
    #[arg(
        long,
        default_value = "auto",
        value_parser = PossibleValuesParser::new(ExifOrientation::NAMES).try_map(|name| name.parse::<ExifOrientation>())
    )]
    exif_orientation: ExifOrientation,

    /// Masks of photographs: auto finds them by their names; none reads photographs whole
    #[arg(long, value_name = "auto|none|FOLDER", default_value = "auto")]
    masks: MaskSource,

    /// What masks and transparency mean: auto ignores what masks hide and cuts out what is transparent
    #[arg(
        long,
        default_value = "auto",
        value_parser = PossibleValuesParser::new(MaskMode::NAMES).try_map(|name| name.parse::<MaskMode>())
    )]
    mask_mode: MaskMode,
    /// Leave listed photographs that are missing out, rather than refuse the dataset
    #[arg(long)]
    skip_missing: bool,

    /// Photographs to hold out: auto (the layout's own test views, else every eighth) or a sector of neighboring cameras
    #[arg(
        long,
        default_value = "auto",
        value_parser = PossibleValuesParser::new(HoldOut::NAMES).try_map(|name| name.parse::<HoldOut>())
    )]
    holdout: HoldOut,

    /// Width in pixels to which wider photographs are downscaled, for training and held-out views alike
    #[arg(long, value_name = "16..8192", default_value = "1600")]
    max_width: MaxWidth,
}

impl ReadFlags {
    pub(super) fn options(&self) -> ReadOptions {
        let Self { exif_orientation, masks, mask_mode, skip_missing, holdout, max_width } = self;
        ReadOptions {
            exif_orientation: *exif_orientation,
            masks: masks.clone(),
            mask_mode: *mask_mode,
            skip_missing: *skip_missing,
            holdout: *holdout,
            max_width: *max_width,
        }
    }
}

/// How the dataset of a scene is read for it again: as its training read it, if the file says how, but for photographs that are missing.
pub(super) fn of_scene(file: &[u8]) -> ReadOptions {
    let trained = trained_with(file).map(|options| options.reading());
    ReadOptions { skip_missing: true, ..trained.unwrap_or(LENIENT) }
}

/// The options that a `.tcgs` file was trained with, if this version knows all of them.
fn trained_with(file: &[u8]) -> Option<TrainOptions> {
    let mut settings = inspect(file).ok()?.manifest.provenance.settings;
    // What the run chose stands beside its options.
    settings.as_object_mut()?.remove("choices");
    serde_json::from_value(settings).ok()
}

/// For commands that use what is there of a dataset whose training decided about missing photographs.
pub(super) const LENIENT: ReadOptions = ReadOptions {
    exif_orientation: ExifOrientation::Auto,
    masks: MaskSource::Auto,
    mask_mode: MaskMode::Auto,
    skip_missing: true,
    holdout: HoldOut::Auto,
    max_width: MaxWidth::DEFAULT,
};
