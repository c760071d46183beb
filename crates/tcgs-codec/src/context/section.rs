//! The context section: the frame of the planes, and the networks of the groups that have one.

use std::ops::Range;

use super::{dense::IntegerMlp, model::ContextNetwork};
use crate::{
    bytes::{Reader, Writer},
    domain::{AttributeGroup, ContextFrame, context_model::ContextKind},
    error::Result,
};

const PART: &str = "context";

/// The context section; `networks` in the order of [`AttributeGroup::ALL`].
pub(crate) fn encode(frame: &ContextFrame, networks: [Option<&ContextNetwork>; 3]) -> Vec<u8> {
    let mut writer = Writer::new();
    frame.center.iter().for_each(|cell| writer.signed(i64::from(*cell)));
    frame.half.iter().for_each(|cells| writer.varint(u64::from(*cells)));
    for network in networks.into_iter().flatten() {
        let bytes = network.mlp.encode();
        writer.varint(bytes.len() as u64);
        writer.raw(&bytes);
    }
    writer.into_bytes()
}

/// The section taken apart; places are offsets within it and tile it.
pub(crate) struct Layout {
    pub(crate) frame: ContextFrame,
    /// The frame's bytes.
    pub(crate) frame_place: Range<usize>,
    /// Each network's bytes with their length, empty for a group without one.
    pub(crate) places: [Range<usize>; 3],
    /// Where the networks themselves begin.
    starts: [usize; 3],
}

impl Layout {
    /// Reads the frame and finds the networks of a file with these kinds.
    pub(crate) fn read(section: &[u8], kinds: [Option<ContextKind>; 3]) -> Result<Self> {
        let mut reader = Reader::new(PART, section);
        let mut frame = ContextFrame { center: [0; 3], half: [1; 3] };
        for cell in &mut frame.center {
            let value = reader.signed("center")?;
            *cell = i32::try_from(value).map_err(|_| reader.malformed("center", value))?;
        }
        for cells in &mut frame.half {
            let value = reader.varint("half")?;
            let half = u32::try_from(value).ok().filter(|half| *half > 0);
            *cells = half.ok_or_else(|| reader.malformed("half", value))?;
        }
        let frame_place = 0..reader.position();
        let mut places = [0..0, 0..0, 0..0];
        let mut starts = [0; 3];
        for ((place, start), kind) in places.iter_mut().zip(&mut starts).zip(kinds) {
            let first = reader.position();
            if kind.is_some() {
                let length = reader.varint("length of a network")?;
                *start = reader.position();
                reader.take("a network", length)?;
            }
            *place = first..reader.position();
        }
        reader.end()?;
        Ok(Self { frame, frame_place, places, starts })
    }

    /// Reads the networks, for planes of `plane_channels` channels and groups of `channels` channels.
    pub(crate) fn networks(
        &self,
        section: &[u8],
        kinds: [Option<ContextKind>; 3],
        plane_channels: usize,
        channels: [usize; 3],
        max_memory_bytes: u64,
    ) -> Result<[Option<ContextNetwork>; 3]> {
        let mut networks = [None, None, None];
        for (group, network) in networks.iter_mut().enumerate() {
            let Some(kind) = kinds[group] else { continue };
            let bytes = &section[self.starts[group]..self.places[group].end];
            let inputs = kind.inputs(plane_channels);
            let outputs = AttributeGroup::outputs(channels[group]);
            let mlp =
                IntegerMlp::decode(PART, &mut Reader::new(PART, bytes), inputs, outputs, max_memory_bytes)?;
            *network = Some(ContextNetwork { kind, mlp });
        }
        Ok(networks)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_frame_is_of_cells_and_has_an_extent_on_every_axis() {
        let read = |center: [i64; 3], half: [u64; 3]| {
            let mut writer = Writer::new();
            center.iter().for_each(|cell| writer.signed(*cell));
            half.iter().for_each(|cells| writer.varint(*cells));
            Layout::read(&writer.into_bytes(), [None; 3]).map(|layout| layout.frame)
        };
        let (center, half) = ([i32::MIN, 0, i32::MAX], [1, 77, u32::MAX]);
        let frame = ContextFrame { center, half };
        assert_eq!(read(center.map(i64::from), half.map(u64::from)), Ok(frame));
        for axis in 0..3 {
            for wrong in [i64::from(i32::MIN) - 1, 1 << 31, i64::MAX] {
                let mut center = [0; 3];
                center[axis] = wrong;
                let error = read(center, [1; 3]).expect_err("must be refused").to_string();
                assert!(error.contains(&format!("center is {wrong}")), "{error}");
            }
            for wrong in [0, 1 << 32, u64::MAX] {
                let mut half = [1; 3];
                half[axis] = wrong;
                let error = read([0; 3], half).expect_err("must be refused").to_string();
                assert!(error.contains(&format!("half is {wrong}")), "{error}");
            }
        }
    }
}
