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
}

#[cfg(test)]
mod tests {
    use super::*;

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
