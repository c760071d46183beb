//! The optional section on showing the scene: the depth from which cameras see. Absent, that is the usual one.

use super::{
    bytes::{Reader, Writer},
    container::Section,
    error::DecodeError,
};
use crate::domain::NearPlane;

const PART: &str = "view";

/// The section, if one is needed.
pub(super) fn encode(near: NearPlane) -> Option<Vec<u8>> {
    (!near.is_usual()).then(|| {
        let mut writer = Writer::new();
        writer.f32(near.depth());
        writer.into_bytes()
    })
}

/// What the section says, or the usual where there is none.
pub(super) fn decode(section: Option<Section<'_>>) -> Result<NearPlane, DecodeError> {
    let Some(section) = section else { return Ok(NearPlane::USUAL) };
    let mut reader = Reader::new(PART, section.bytes);
    let depth = reader.f32("near plane")?;
    reader.end()?;
    NearPlane::new(depth).ok_or_else(|| reader.malformed("near plane", depth))
}
