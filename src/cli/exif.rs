//! The flag for the EXIF orientation of photographs, as commands that read a dataset take it.

use clap::builder::{PossibleValuesParser, TypedValueParser as _};
use tcgs::domain::ExifOrientation;

/// What the EXIF orientation of photographs does.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(super) struct ExifFlag {
    /// EXIF orientation of photographs: auto applies it where cameras and points agree with the turned pixels
    #[arg(
        long,
        default_value = "auto",
        value_parser = PossibleValuesParser::new(ExifOrientation::NAMES).try_map(|name| name.parse::<ExifOrientation>())
    )]
    pub(super) exif_orientation: ExifOrientation,
}
