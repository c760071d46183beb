//! How cameras of photographs that have none are found: what a user may choose.

use super::{MaskSource, choice::named_choice};

/// What decides the search for cameras in one set of photographs: another may find other cameras.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct CameraSearchOptions {
    /// The model of every camera.
    pub camera_model: CameraModel,
    /// Which photographs are compared.
    pub matching: Matching,
    /// Where masks are that hide what cameras must not be placed by; none if masks cut out an object.
    pub masks: MaskSource,
}

named_choice! {
    /// COLMAP's camera models that training reads.
    #[derive(Default)]
    pub enum CameraModel {
        /// A focal length and one term of radial distortion: the safest choice for a telephone or a camera.
        #[default]
        SimpleRadial = "simple-radial",
        /// A focal length.
        SimplePinhole = "simple-pinhole",
        /// A focal length an axis.
        Pinhole = "pinhole",
        /// A focal length and two terms of radial distortion.
        Radial = "radial",
        /// A focal length an axis, two terms of radial and two of tangential distortion.
        Opencv = "opencv",
    }
}

impl CameraModel {
    /// As COLMAP calls it.
    #[must_use]
    pub fn colmap_name(self) -> String {
        self.name().replace('-', "_").to_uppercase()
    }
}

named_choice! {
    /// Which pairs of photographs are compared.
    #[derive(Default)]
    pub enum Matching {
        /// Every pair of up to 200 photographs, else neighbors.
        #[default]
        Auto = "auto",
        /// Every pair.
        Exhaustive = "exhaustive",
        /// Each photograph and those after it in the order of names, and evenly spread ones with each other, so that loops close.
        Sequential = "sequential",
    }
}

impl Matching {
    /// The pairs of frames of a video: neighbors unless others are chosen.
    #[must_use]
    pub fn of_a_video(self) -> Self {
        match self {
            Self::Auto => Self::Sequential,
            chosen => chosen,
        }
    }
}
