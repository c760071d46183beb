//! Flags for how a dataset is read, as commands take them that train on none.

use clap::builder::{PossibleValuesParser, TypedValueParser as _};
use tcgs::domain::{ExifOrientation, ReadOptions};

/// How a dataset is read.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct ReadFlags {
    /// EXIF orientation of photographs: auto applies it where cameras and points agree with the turned pixels
    #[arg(
        long,
        default_value = "auto",
        value_parser = PossibleValuesParser::new(ExifOrientation::NAMES).try_map(|name| name.parse::<ExifOrientation>())
    )]
    exif_orientation: ExifOrientation,

    /// Leave listed photographs that are missing out, rather than refuse the dataset
    #[arg(long)]
    skip_missing: bool,
}

impl ReadFlags {
    pub(super) fn options(&self) -> ReadOptions {
        let Self { exif_orientation, skip_missing } = self;
        ReadOptions { exif_orientation: *exif_orientation, skip_missing: *skip_missing }
    }
}

/// For commands that use what is there of a dataset whose training decided about missing photographs.
pub(super) const LENIENT: ReadOptions =
    ReadOptions { exif_orientation: ExifOrientation::Auto, skip_missing: true };
