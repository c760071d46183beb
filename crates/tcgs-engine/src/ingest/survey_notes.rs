//! What a survey notes of a dataset as a whole: images that were changed, and coordinates far out.

use glam::DVec3;

use super::{distortion::Distortion, surveyed_frame::SurveyedFrame};
use crate::domain::Intrinsics;

/// Distance from the origin, in radii of the cameras' own extent, from which coordinates are noted as far out.
const FAR_OUT: f64 = 1000.0;

/// Distance in world units from which coordinates are those of a map or of the Earth, unless the cameras are as far apart.
const MAP_DISTANCE: f64 = 1e5;

/// How often a scene's radius fits into that distance at least.
const MAP_RADII: f64 = 20.0;

/// A note on coordinates as far from the origin as those of maps and of the whole Earth are: other programs read them in single
/// precision.
pub(super) fn distance_note(views: &[SurveyedFrame]) -> Option<String> {
    let centers: Vec<DVec3> = views.iter().map(|view| view.frame.pose.center()).collect();
    let mean = centers.iter().sum::<DVec3>() / centers.len().max(1) as f64;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    let distance = mean.length();
    let radii = if distance >= MAP_DISTANCE { MAP_RADII } else { FAR_OUT };
    if radius == 0.0 || distance < radii * radius {
        return None;
    }
    // The distance between neighboring numbers of single precision.
    let step =
        f64::from((mean.abs().max_element() as f32).next_up()) - f64::from(mean.abs().max_element() as f32);
    // Zero without a sign.
    let DVec3 { x, y, z } = mean.round() + 0.0;
    Some(format!(
        "the cameras are {distance:.0} units from the origin, around ({x}, {y}, {z}), and within {radius:.3} of each other, as in UTM \
         or ECEF coordinates: training does not mind, but single precision has steps of {step} there, so exported files may be \
         relative to an offset, which they state"
    ))
}

/// How many images were changed and how, for the notes.
#[derive(Default)]
pub(super) struct Changes {
    smaller_than_stated: usize,
    undistorted: usize,
    /// The largest angle from the axis, in degrees, of the pictures of lenses that may be wide.
    angle: Option<f64>,
    masked: usize,
    cropped: Option<((u32, u32), (u32, u32))>,
    downscaled: usize,
    /// The width of those.
    width: u32,
}

impl Changes {
    /// Counts what was done to an image whose camera states a size.
    pub(super) fn count(&mut self, stated: Option<(u32, u32)>, view: &SurveyedFrame) {
        let size = |k: &Intrinsics| (k.width, k.height);
        let (stored, crop) = (&view.stored, (view.crop.width, view.crop.height));
        self.smaller_than_stated += usize::from(stated.is_some_and(|stated| stated != size(stored)));
        self.undistorted += usize::from(!view.distortion.is_none());
        self.masked += usize::from(view.valid.is_some());
        if matches!(view.distortion, Distortion::Projection(_)) {
            let angle = corner_angle(&view.camera.intrinsics);
            self.angle = Some(self.angle.map_or(angle, |largest| largest.max(angle)));
        }
        if self.cropped.is_none() && size(stored) != crop {
            self.cropped = Some((size(stored), crop));
        }
        if view.camera.intrinsics.width != view.crop.width {
            self.downscaled += 1;
            self.width = view.camera.intrinsics.width;
        }
    }

    /// Adds the notes.
    pub(super) fn note(&self, notes: &mut Vec<String>) {
        if self.smaller_than_stated > 0 {
            notes.push(format!(
                "images smaller than their camera states: {}; the intrinsics were scaled to them",
                self.smaller_than_stated
            ));
        }
        if self.undistorted > 0 {
            let crop = self.cropped.map_or_else(String::new, |((w, h), (to_w, to_h))| {
                format!(", cropped to what the lens saw ({w}x{h} to {to_w}x{to_h})")
            });
            let angle = self.angle.map_or_else(String::new, |angle| {
                format!("; at the stated focal length, the corners are {angle:.0} degrees from the axis")
            });
            notes.push(format!("images undistorted: {}{crop}{angle}", self.undistorted));
        }
        if self.masked > 0 {
            notes.push(format!(
                "images with borders that the lens did not see: {}; these are neither learnt nor measured",
                self.masked
            ));
        }
        if self.downscaled > 0 {
            notes.push(format!(
                "images wider than {} pixels, downscaled to that width: {}",
                self.width, self.downscaled
            ));
        }
    }
}

/// The angle of the farthest corner from the axis, in degrees.
fn corner_angle(k: &Intrinsics) -> f64 {
    let far = |center: f64, side: u32, focal: f64| center.abs().max((f64::from(side) - center).abs()) / focal;
    far(k.cx, k.width, k.fx).hypot(far(k.cy, k.height, k.fy)).atan().to_degrees()
}
