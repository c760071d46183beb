//! How the files of a dataset are read: what may be read in more than one way.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error as _};

use super::choice::named_choice;

named_choice! {
    /// Whether photographs are turned as the EXIF orientation in them says.
    #[derive(Default)]
    pub enum ExifOrientation {
        /// Where the cameras are those of the turned pixels.
        #[default]
        Auto = "auto",
        /// Always.
        Apply = "apply",
        /// Never.
        Ignore = "ignore",
    }
}

named_choice! {
    /// What masks and transparency mean.
    #[derive(Default)]
    pub enum MaskMode {
        /// What masks hide is ignored; what is transparent is cut out.
        #[default]
        Auto = "auto",
        /// Both hide what is neither learnt nor measured.
        Ignore = "ignore",
        /// Both cut out an object: what is hidden is background.
        CutOut = "cut_out",
    }
}

named_choice! {
    /// Which photographs are held out.
    #[derive(Default)]
    pub enum HoldOut {
        /// The layout's own test views; without such, every eighth by name.
        #[default]
        Auto = "auto",
        /// The eighth of all photographs whose cameras are nearest to that of the first by name.
        Sector = "sector",
    }
}

impl HoldOut {
    /// In words that are stored with the figures.
    #[must_use]
    pub fn convention(self) -> &'static str {
        match self {
            HoldOut::Auto => {
                "the layout's own test views; without such, every eighth view by name from the first on"
            }
            HoldOut::Sector => {
                "a sector: the eighth of all views whose cameras are nearest to that of the first by name"
            }
        }
    }
}

/// The longest path of a folder of masks, in characters.
const MAX_FOLDER_CHARS: usize = 200;

/// Where masks are.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum MaskSource {
    /// Where files state them, in folders of masks, or beside their photographs.
    #[default]
    Auto,
    /// Nowhere: photographs are read whole.
    None,
    /// In this folder of the dataset.
    Folder(String),
}

impl fmt::Display for MaskSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            MaskSource::Auto => f.write_str("auto"),
            MaskSource::None => f.write_str("none"),
            MaskSource::Folder(folder) => f.write_str(folder),
        }
    }
}

impl FromStr for MaskSource {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // As the contract's pattern, whose end may stand before a line's end.
        let text = text.strip_suffix('\n').unwrap_or(text);
        let folder = text.strip_suffix('/').unwrap_or(text);
        let is_name =
            |part: &str| !part.is_empty() && !part.starts_with('.') && !part.contains(['\\', '?', '*']);
        match text {
            "auto" => Ok(Self::Auto),
            "none" => Ok(Self::None),
            _ if text.chars().count() <= MAX_FOLDER_CHARS
                && !text.contains(char::is_control)
                && folder.split('/').all(is_name) =>
            {
                Ok(Self::Folder(folder.to_owned()))
            }
            _ => Err("not auto, none or the path of a folder in the dataset".to_owned()),
        }
    }
}

impl Serialize for MaskSource {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for MaskSource {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}

/// The widest photographs that are trained on, in pixels; wider ones are downscaled to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "u32")]
pub struct MaxWidth(u32);

impl MaxWidth {
    /// As the field's loaders have it (METHOD.md §1.1).
    pub const DEFAULT: Self = Self(1600);
    /// The smallest.
    pub const MIN: u32 = 16;
    /// The largest.
    pub const MAX: u32 = 8192;

    /// This width.
    ///
    /// # Errors
    /// The bounds, if it is not within [`MaxWidth::MIN`] and [`MaxWidth::MAX`].
    pub fn new(pixels: u32) -> Result<Self, String> {
        match pixels {
            Self::MIN..=Self::MAX => Ok(Self(pixels)),
            _ => Err(format!("not a number of pixels from {} to {}", Self::MIN, Self::MAX)),
        }
    }

    /// In pixels.
    #[must_use]
    pub const fn pixels(self) -> u32 {
        self.0
    }
}

impl Default for MaxWidth {
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl TryFrom<u32> for MaxWidth {
    type Error = String;

    fn try_from(pixels: u32) -> Result<Self, String> {
        Self::new(pixels)
    }
}

impl FromStr for MaxWidth {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        text.parse().map_err(|_| format!("'{text}' is not a number")).and_then(Self::new)
    }
}

impl fmt::Display for MaxWidth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// How the files of a dataset are read.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// What EXIF orientations do.
    pub exif_orientation: ExifOrientation,
    /// Where masks are.
    pub masks: MaskSource,
    /// What masks and transparency mean.
    pub mask_mode: MaskMode,
    /// Whether listed photographs that are missing are left out, rather than the dataset refused.
    pub skip_missing: bool,
    /// Which photographs are held out.
    pub holdout: HoldOut,
    /// The width to which wider photographs are downscaled.
    pub max_width: MaxWidth,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_have_bounds_and_are_numbers_in_json() {
        assert_eq!(MaxWidth::default().pixels(), 1600);
        for pixels in [MaxWidth::MIN, 400, MaxWidth::MAX] {
            let width = MaxWidth::new(pixels).expect("a width");
            assert_eq!(pixels.to_string().parse(), Ok(width));
            assert_eq!(serde_json::to_string(&width).expect("JSON"), pixels.to_string());
        }
        for text in ["", "15", "8193", "-400", "400.0", "wide"] {
            assert!(text.parse::<MaxWidth>().is_err(), "{text}");
            assert!(serde_json::from_str::<MaxWidth>(text).is_err(), "{text}");
        }
    }

    #[test]
    fn sources_of_masks_are_names_or_folders() {
        for (text, source) in [
            ("auto", MaskSource::Auto),
            ("none", MaskSource::None),
            ("my masks/a/", MaskSource::Folder("my masks/a".to_owned())),
        ] {
            assert_eq!(text.parse(), Ok(source.clone()));
            let json = serde_json::to_string(&source).expect("JSON");
            assert_eq!(serde_json::from_str::<MaskSource>(&json).expect("a source"), source);
        }
        for text in ["", "/", "../masks", "a//b", "/etc", "a\\b", "?", "a\nb", ".a", "a//", &"a".repeat(201)]
        {
            assert!(text.parse::<MaskSource>().is_err(), "{text}");
        }
    }
}
