//! The optional sections that rendering needs: frame, degree of the view direction, near plane and scene scale. A file without one has
//! the default.

use glam::DVec3;

use super::{
    bytes::{Reader, Writer},
    container::Section,
    error::Result,
};
use crate::domain::{NearPlane, SceneFrame, SceneScale, ViewDegree};

const VIEW: &str = "view";
const UNIT: &str = "unit";
const FRAME: &str = "frame";
const DIRECTIONS: &str = "directions";

/// The section of the frame, if one is needed: offset and scale.
pub(super) fn encode_frame(frame: SceneFrame) -> Option<Vec<u8>> {
    let numbers = || frame.offset().to_array().into_iter().chain([frame.scale()]);
    (!frame.is_world()).then(|| numbers().flat_map(f64::to_le_bytes).collect())
}

/// The value of that section, or the default without it.
pub(super) fn decode_frame(section: Option<Section<'_>>) -> Result<SceneFrame> {
    let Some(section) = section else { return Ok(SceneFrame::WORLD) };
    let mut reader = Reader::new(FRAME, section.bytes);
    let [x, y, z, scale] =
        [reader.f64("offset")?, reader.f64("offset")?, reader.f64("offset")?, reader.f64("scale")?];
    reader.end()?;
    let frame = SceneFrame::new(DVec3::new(x, y, z), scale);
    frame.ok_or_else(|| reader.malformed("frame", format!("{x} {y} {z} {scale}")))
}

/// The section of the degree of the view direction, if one is needed.
pub(super) fn encode_view_degree(degree: Option<ViewDegree>) -> Option<Vec<u8>> {
    degree.filter(|degree| !degree.is_default()).map(|degree| vec![degree.get()])
}

/// The value of that section, or the default without it.
pub(super) fn decode_view_degree(section: Option<Section<'_>>) -> Result<ViewDegree> {
    let Some(section) = section else { return Ok(ViewDegree::DEFAULT) };
    let mut reader = Reader::new(DIRECTIONS, section.bytes);
    let degree = reader.u8("degree")?;
    reader.end()?;
    // The default is stated by leaving the section out.
    let stated = ViewDegree::new(degree).filter(|degree| !degree.is_default());
    stated.ok_or_else(|| reader.malformed("degree", degree))
}

/// The section of the near plane, if one is needed.
pub(super) fn encode_near(near: NearPlane) -> Option<Vec<u8>> {
    (!near.is_default()).then(|| one(near.depth()))
}

/// The value of that section, or the default without it.
pub(super) fn decode_near(section: Option<Section<'_>>) -> Result<NearPlane> {
    decode(section, VIEW, "near plane", NearPlane::new)
}

/// The section of the scene scale, if one is needed.
pub(super) fn encode_scene_scale(scene_scale: SceneScale) -> Option<Vec<u8>> {
    (!scene_scale.is_default()).then(|| one(scene_scale.length()))
}

/// The value of that section, or the default without it.
pub(super) fn decode_scene_scale(section: Option<Section<'_>>) -> Result<SceneScale> {
    decode(section, UNIT, "scene scale", SceneScale::new)
}

fn one(value: f32) -> Vec<u8> {
    let mut writer = Writer::new();
    writer.f32(value);
    writer.into_bytes()
}

fn decode<T: Default>(
    section: Option<Section<'_>>,
    part: &'static str,
    what: &'static str,
    allowed: impl Fn(f32) -> Option<T>,
) -> Result<T> {
    let Some(section) = section else { return Ok(T::default()) };
    let mut reader = Reader::new(part, section.bytes);
    let value = reader.f32(what)?;
    reader.end()?;
    allowed(value).ok_or_else(|| reader.malformed(what, value))
}
