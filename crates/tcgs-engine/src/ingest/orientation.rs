//! Decides whether photographs are turned as the EXIF orientation in them says.
//!
//! The programs that compute cameras differ: some turn the pixels first, others read them as they are stored. So the cameras decide. Where
//! a camera's size fits only one of both readings, that is the one. Elsewhere (half turns, mirror images, square photographs, cameras
//! without a size) the colors of the points do: in the right reading they differ from the photographs by a few levels of 255, in the
//! wrong one by several times as much. Without colors the sizes of the other photographs decide, since one program computed all cameras;
//! without these, pixels stay as they are stored.

use glam::DVec3;
use image::metadata::Orientation;

use super::{
    images::{Header, swaps_sides},
    lens::Lens,
};
use crate::domain::{Camera, ExifOrientation, Image, PointCloud};

/// How many photographs are compared with the points.
pub(super) const MAX_COMPARED: usize = 6;

/// How many points are compared with each of them.
const MAX_POINTS: usize = 10_000;

/// Fewest points in a photograph whose colors mean anything.
const MIN_POINTS: usize = 30;

/// How many times as much the wrong reading differs at least.
const MIN_RATIO: f64 = 1.25;

/// What tells which way up a photograph is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Evidence {
    /// It has no orientation, or that of its pixels.
    Upright,
    /// The caller's option.
    Stated(Reading),
    /// The size of its camera.
    Size(Reading),
    /// Neither.
    None,
}

/// How a photograph with an orientation is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reading {
    /// With its pixels as stored.
    Stored,
    /// Turned as its orientation says.
    Turned,
}

impl Reading {
    /// How the stored pixels are turned.
    pub(super) fn turn(self, header: &Header) -> Orientation {
        match self {
            Self::Stored => Orientation::NoTransforms,
            Self::Turned => header.orientation,
        }
    }

    /// Width and height in this reading.
    pub(super) fn size(self, header: &Header) -> (u32, u32) {
        let (width, height) = header.size;
        if swaps_sides(self.turn(header)) { (height, width) } else { (width, height) }
    }
}

/// What a photograph's own header, camera and the option tell.
pub(super) fn evidence(header: &Header, lens: &Lens, option: ExifOrientation) -> Evidence {
    if header.orientation == Orientation::NoTransforms {
        return Evidence::Upright;
    }
    match option {
        ExifOrientation::Apply => return Evidence::Stated(Reading::Turned),
        ExifOrientation::Ignore => return Evidence::Stated(Reading::Stored),
        ExifOrientation::Auto => {}
    }
    let fits = |reading: Reading| lens.size.is_some() && lens.fits(reading.size(header));
    match (fits(Reading::Stored), fits(Reading::Turned)) {
        (true, false) => Evidence::Size(Reading::Stored),
        (false, true) => Evidence::Size(Reading::Turned),
        _ => Evidence::None,
    }
}

/// What the photographs without evidence of their own are read as, and why.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Decision {
    /// By colors: how much the points differ from the pixels as stored and turned, of 255.
    Colors { stored: f64, turned: f64 },
    /// As the other photographs' sizes.
    OtherSizes(Reading),
    /// Nothing tells.
    Unknown(Unknown),
}

/// Why nothing tells which way up photographs are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unknown {
    /// There are no points with colors.
    NoColors,
    /// The points' colors fit both readings alike.
    Alike,
    /// Pixels are not read by this check.
    NotRead,
}

impl Decision {
    /// The reading.
    pub(super) fn reading(self) -> Reading {
        match self {
            Self::Colors { stored, turned } if turned < stored => Reading::Turned,
            Self::OtherSizes(reading) => reading,
            Self::Colors { .. } | Self::Unknown(_) => Reading::Stored,
        }
    }
}

/// The differences between points and photographs in both readings.
#[derive(Debug, Default)]
pub(super) struct Comparison {
    stored: Vec<f64>,
    turned: Vec<f64>,
}

impl Comparison {
    /// Adds one photograph in both readings, each with its camera.
    pub(super) fn add(&mut self, points: &PointCloud, stored: (&Camera, &Image), turned: (&Camera, &Image)) {
        let differences = [stored, turned].map(|(camera, image)| difference(points, camera, image));
        if let [Some(stored), Some(turned)] = differences {
            self.stored.push(stored);
            self.turned.push(turned);
        }
    }

    /// The decision by colors, if they decide.
    pub(super) fn decision(&self) -> Option<Decision> {
        let count = self.stored.len() as f64;
        let mean = |values: &[f64]| values.iter().sum::<f64>() / count;
        let (stored, turned) = (mean(&self.stored), mean(&self.turned));
        let decides = count > 0.0 && stored.max(turned) >= MIN_RATIO * stored.min(turned);
        // Two perfect fits decide nothing.
        (decides && stored != turned).then_some(Decision::Colors { stored, turned })
    }
}

/// The lower quartile over points in view of the mean difference of a point's channels from its pixel; `None` with few points in view. Of
/// points all around an object half are behind others, so a median would be that of hidden points.
fn difference(points: &PointCloud, camera: &Camera, image: &Image) -> Option<f64> {
    let step = points.positions.len().div_ceil(MAX_POINTS).max(1);
    let channels = usize::from(image.channels());
    let k = &camera.intrinsics;
    let pairs = points.positions.iter().zip(&points.colors).step_by(step);
    let of_point = |(position, color): (&[f64; 3], &[u8; 3])| {
        let seen = camera.pose.rotation() * DVec3::from(*position) + camera.pose.translation();
        let (x, y) = (k.fx * seen.x / seen.z + k.cx, k.fy * seen.y / seen.z + k.cy);
        let is_in_view =
            seen.z > 0.0 && x >= 0.0 && y >= 0.0 && x < f64::from(k.width) && y < f64::from(k.height);
        is_in_view.then(|| {
            let at = (y as usize * image.width() as usize + x as usize) * channels;
            let pixel = &image.samples()[at..at + 3];
            let sum: f64 =
                pixel.iter().zip(color).map(|(pixel, color)| f64::from(pixel.abs_diff(*color))).sum();
            sum / 3.0
        })
    };
    let mut differences: Vec<f64> = pairs.filter_map(of_point).collect();
    if differences.len() < MIN_POINTS {
        return None;
    }
    let quartile = differences.len() / 4;
    Some(*differences.select_nth_unstable_by(quartile, f64::total_cmp).1)
}

/// Photographs by what was done with them, for the notes.
#[derive(Debug, Default)]
pub(super) struct EvidenceCounts {
    stated: [usize; 2],
    sized: [usize; 2],
    others: usize,
}

impl EvidenceCounts {
    /// Counts a photograph.
    pub(super) fn count(&mut self, evidence: Evidence) {
        match evidence {
            Evidence::Upright => {}
            Evidence::Stated(reading) => self.stated[reading as usize] += 1,
            Evidence::Size(reading) => self.sized[reading as usize] += 1,
            Evidence::None => self.others += 1,
        }
    }

    /// Whether any photograph has no evidence of its own.
    pub(super) fn has_others(&self) -> bool {
        self.others > 0
    }

    /// What sizes tell of all photographs, where they agree.
    pub(super) fn by_sizes(&self) -> Option<Decision> {
        match self.sized {
            [0, 0] => None,
            [_, 0] => Some(Decision::OtherSizes(Reading::Stored)),
            [0, _] => Some(Decision::OtherSizes(Reading::Turned)),
            _ => None,
        }
    }

    /// Says what was done and why.
    pub(super) fn note(&self, decision: Option<Decision>, notes: &mut Vec<String>) {
        let photographs = |count: usize| format!("{count} photograph{}", if count == 1 { "" } else { "s" });
        let applied = |count, why: &str| format!("EXIF orientation applied to {}: {why}", photographs(count));
        let ignored =
            |count, why: &str| format!("EXIF orientation not applied to {}: {why}", photographs(count));
        for (counts, stored, turned) in [
            (self.stated, "exif_orientation=ignore", "exif_orientation=apply"),
            (
                self.sized,
                "their cameras have the size of the stored pixels",
                "their cameras have the size of the turned pixels",
            ),
        ] {
            if counts[0] > 0 {
                notes.push(ignored(counts[0], stored));
            }
            if counts[1] > 0 {
                notes.push(applied(counts[1], turned));
            }
        }
        let Some(decision) = decision.filter(|_| self.others > 0) else { return };
        let why = match decision {
            Decision::Colors { stored, turned } => format!(
                "the points' colors differ from the pixels by {turned:.0} of 255 if it is, and by {stored:.0} as stored"
            ),
            Decision::OtherSizes(_) => "so it is with the photographs whose cameras' sizes tell".to_owned(),
            Decision::Unknown(Unknown::NoColors) => {
                "the sizes do not tell, and there are no colored points to compare with; exif_orientation=apply turns them"
                    .to_owned()
            }
            Decision::Unknown(Unknown::Alike) => {
                "neither the sizes nor the points' colors tell; exif_orientation=apply turns them".to_owned()
            }
            Decision::Unknown(Unknown::NotRead) => {
                notes.push(format!(
                    "{} have an EXIF orientation and cameras whose size does not tell whether it applies: training compares their \
                     pixels with the points' colors",
                    photographs(self.others)
                ));
                return;
            }
        };
        notes.push(match decision.reading() {
            Reading::Turned => applied(self.others, &why),
            Reading::Stored => ignored(self.others, &why),
        });
    }
}
