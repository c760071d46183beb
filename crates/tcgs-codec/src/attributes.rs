//! The attributes section: the tables of groups without a network, a chunk index, then chunks that decode on their own.
//!
//! A chunk holds consecutive anchors in file order as three streams: features, scalings, offsets. Chunks are
//! coded in parallel; each is a function of its own bytes, so the result does not depend on the threads.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    alloc::{reserve, zeros},
    bytes::{Reader, Writer},
    context::{AnchorContext, BaseModel, GroupModel, quant_steps::MAX_STEP_INDEX},
    error::{DecodeError, Result},
    fit,
    range::StreamDecoder,
    shape::{Attribute, SceneShape},
};
use crate::domain::context_model::ContextKind;

const PART: &str = "attributes";

/// Streams of a chunk, by attribute, as the errors name them.
const STREAMS: [&str; 3] = ["features", "scalings", "offsets"];

/// Fewest bytes of a chunk's index entry: three varints and a checksum.
const MIN_ENTRY_BYTES: usize = 7;

/// An attribute group as the encoder coded it.
pub(super) struct CodedGroup {
    /// What predicts it.
    pub(super) model: GroupModel,
    /// Of each chunk.
    pub(super) streams: Vec<Vec<u8>>,
    /// `[N][channels]` integers.
    pub(super) symbols: Vec<i32>,
    /// `[N]` step indices.
    pub(super) step_indices: Vec<i8>,
}

/// The attributes section, of groups in the order of [`Attribute::ALL`].
pub(super) fn encode(groups: [&CodedGroup; 3]) -> Vec<u8> {
    let _stage = tracing::debug_span!("section").entered();
    let mut writer = Writer::new();
    groups.iter().for_each(|group| write_parameters(&group.model.base, &mut writer));
    for chunk in 0..groups[0].streams.len() {
        let streams = groups.map(|group| &group.streams[chunk]);
        streams.iter().for_each(|stream| writer.varint(stream.len() as u64));
        writer.u32(streams.iter().fold(0, |crc, stream| crc32c::crc32c_append(crc, stream)));
    }
    for chunk in 0..groups[0].streams.len() {
        groups.iter().for_each(|group| writer.raw(&group.streams[chunk]));
    }
    writer.into_bytes()
}

/// Writes this section's part of a group's model: tables, or nothing for a network.
pub(super) fn write_parameters(model: &BaseModel, writer: &mut Writer) {
    if let BaseModel::Static { step_index, channels } = model {
        writer.signed(i64::from(*step_index));
        channels.iter().for_each(|distribution| fit::write(*distribution, writer));
    }
}

fn read_tables(reader: &mut Reader<'_>, channels: usize) -> Result<BaseModel> {
    let step_index = reader.signed("a step")?;
    if step_index.unsigned_abs() > u64::from(MAX_STEP_INDEX.unsigned_abs()) {
        return Err(reader.malformed("a step", step_index));
    }
    let mut distributions = reserve("channels", channels)?;
    for _ in 0..channels {
        distributions.push(fit::read(reader)?);
    }
    Ok(BaseModel::Static { step_index: step_index as i8, channels: distributions })
}

/// Offsets that are masked off are not in the file.
pub(super) fn is_coded(
    masks: &[bool],
    shape: SceneShape,
    anchor: usize,
    attribute: Attribute,
    channel: usize,
) -> bool {
    attribute != Attribute::Offsets || masks[anchor * shape.offsets_per_anchor + channel / 3]
}

/// The anchors of each chunk.
pub(super) fn ranges(anchors: usize, chunk_anchors: usize) -> Vec<Range<usize>> {
    (0..anchors).step_by(chunk_anchors).map(|start| start..(start + chunk_anchors).min(anchors)).collect()
}

/// The integers of each group, and the step index of each anchor.
pub(super) type Integers = ([Vec<i32>; 3], [Vec<i8>; 3]);

/// The section taken apart but not decoded; all places are offsets within the section and tile it.
pub(super) struct AttributeLayout {
    /// Each attribute's tables, `None` for a network.
    pub(super) tables: [Option<BaseModel>; 3],
    /// Each attribute's model parameters.
    pub(super) parameters: [Range<usize>; 3],
    /// The chunk index.
    pub(super) index: Range<usize>,
    /// Each chunk's streams and checksum.
    pub(super) chunks: Vec<ChunkPlace>,
    /// Anchors in every chunk but the last.
    chunk_anchors: usize,
}

/// A chunk's place in the section.
pub(super) struct ChunkPlace {
    /// Anchors in file order.
    pub(super) anchors: Range<usize>,
    /// Features, scalings, offsets.
    pub(super) streams: [Range<usize>; 3],
    checksum: u32,
}

impl AttributeLayout {
    /// Reads parameters and index, and checks that the chunks fill the rest of the section.
    pub(super) fn read(
        section: &[u8],
        shape: SceneShape,
        chunk_anchors: usize,
        kinds: [Option<ContextKind>; 3],
    ) -> Result<Self> {
        let mut reader = Reader::new(PART, section);
        let mut tables = [None, None, None];
        let mut parameters = [0..0, 0..0, 0..0];
        for attribute in Attribute::ALL {
            let start = reader.position();
            if attribute.of(&kinds).is_none() {
                *attribute.of_mut(&mut tables) = Some(read_tables(&mut reader, shape.channels(attribute))?);
            }
            *attribute.of_mut(&mut parameters) = start..reader.position();
        }
        let index_start = reader.position();
        let count = shape.anchors.div_ceil(chunk_anchors);
        if count > reader.left() / MIN_ENTRY_BYTES {
            return Err(reader.truncated("chunk index", count as u64 * MIN_ENTRY_BYTES as u64));
        }
        let mut entries = reserve("chunk index", count)?;
        for _ in 0..count {
            let lengths = [
                reader.varint("length of features")?,
                reader.varint("length of scalings")?,
                reader.varint("length of offsets")?,
            ];
            entries.push((lengths, reader.u32("chunk checksum")?));
        }
        let index = index_start..reader.position();
        let mut chunks = reserve("chunk index", count)?;
        for (anchors, (lengths, checksum)) in ranges(shape.anchors, chunk_anchors).into_iter().zip(entries) {
            let mut streams = [0..0, 0..0, 0..0];
            for (place, length) in streams.iter_mut().zip(lengths) {
                let start = reader.position();
                reader.take("chunk", length)?;
                *place = start..reader.position();
            }
            chunks.push(ChunkPlace { anchors, streams, checksum });
        }
        reader.end()?;
        Ok(Self { tables, parameters, index, chunks, chunk_anchors })
    }

    /// Decodes every chunk by the groups' models: features, scalings and offsets of all anchors, with the step indices of
    /// each.
    pub(super) fn decode(
        &self,
        section: &[u8],
        shape: SceneShape,
        masks: &[bool],
        models: [&GroupModel; 3],
        anchors: &AnchorContext,
    ) -> Result<Integers> {
        let _stage = tracing::debug_span!("attributes").entered();
        let mut symbols = [Vec::new(), Vec::new(), Vec::new()];
        let mut steps = [Vec::new(), Vec::new(), Vec::new()];
        for attribute in Attribute::ALL {
            *attribute.of_mut(&mut symbols) = zeros("attributes", shape.anchors * shape.channels(attribute))?;
            *attribute.of_mut(&mut steps) = zeros("steps", shape.anchors)?;
        }
        let mut chunks: Vec<ChunkTask<'_>> = self
            .chunks
            .iter()
            .enumerate()
            .map(|(number, place)| ChunkTask { number, place, groups: Vec::with_capacity(3) })
            .collect();
        for ((attribute, symbols), steps) in Attribute::ALL.into_iter().zip(&mut symbols).zip(&mut steps) {
            let symbols = symbols.chunks_mut(self.chunk_anchors * shape.channels(attribute));
            let steps = steps.chunks_mut(self.chunk_anchors);
            for ((chunk, symbols), steps) in chunks.iter_mut().zip(symbols).zip(steps) {
                chunk.groups.push((attribute, symbols, steps));
            }
        }
        let decoded: Vec<Result<()>> = chunks
            .into_par_iter()
            .map(|chunk| chunk.decode(section, shape, masks, models, anchors))
            .collect();
        // In file order, so that the reported error does not depend on the threads.
        decoded.into_iter().collect::<Result<()>>()?;
        Ok((symbols, steps))
    }
}

/// A chunk, and where its integers and step indices go.
struct ChunkTask<'a> {
    number: usize,
    place: &'a ChunkPlace,
    groups: Vec<(Attribute, &'a mut [i32], &'a mut [i8])>,
}

impl ChunkTask<'_> {
    fn decode(
        self,
        section: &[u8],
        shape: SceneShape,
        masks: &[bool],
        models: [&GroupModel; 3],
        context: &AnchorContext,
    ) -> Result<()> {
        let ChunkPlace { anchors, streams, checksum } = self.place;
        let actual = crc32c::crc32c(&section[streams[0].start..streams[2].end]);
        if actual != *checksum {
            return Err(DecodeError::ChunkChecksum { chunk: self.number, stated: *checksum, actual });
        }
        for (attribute, symbols, steps) in self.groups {
            let part = attribute.of(&STREAMS);
            let channels = shape.channels(attribute);
            let mut stream = StreamDecoder::new(part, &section[attribute.of(streams).clone()])?;
            let mut predictions = attribute.of(&models).predictions(context);
            for ((anchor, row), step_index) in
                anchors.clone().zip(symbols.chunks_exact_mut(channels)).zip(steps)
            {
                *step_index = predictions.begin(anchor);
                for (channel, symbol) in row.iter_mut().enumerate() {
                    let coded = is_coded(masks, shape, anchor, attribute, channel);
                    if coded {
                        *symbol = predictions.next(channel).decode(&mut stream)?;
                    }
                    predictions.observe(channel, coded.then_some(*symbol));
                }
            }
            stream.finish()?;
            if attribute == Attribute::Scalings
                && let Some(symbol) = symbols.iter().find(|symbol| **symbol < 1)
            {
                return Err(DecodeError::malformed(part, "a scaling", symbol));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_of_tables_are_those_of_the_step_table() {
        let read = |step: i64| {
            let mut writer = Writer::new();
            writer.signed(step);
            let bytes = writer.into_bytes();
            read_tables(&mut Reader::new(PART, &bytes), 0)
        };
        for step_index in [-16, 0, 16] {
            let tables = BaseModel::Static { step_index, channels: Vec::new() };
            assert_eq!(read(i64::from(step_index)), Ok(tables));
        }
        for step in [-17, 17, 256, i64::MAX, i64::MIN] {
            assert_eq!(read(step), Err(DecodeError::malformed(PART, "a step", step)));
        }
    }

    #[test]
    fn chunks_that_the_section_has_no_room_for_are_refused_before_they_are_read() {
        let shape = SceneShape { anchors: 5, feature_dim: 1, offsets_per_anchor: 1 };
        let read =
            |bytes: usize| AttributeLayout::read(&vec![0; bytes], shape, 2, [Some(ContextKind::Position); 3]);
        // Three chunks of nothing but their entries.
        let layout = read(21).expect("has room for three entries");
        let anchors: Vec<_> = layout.chunks.iter().map(|chunk| chunk.anchors.clone()).collect();
        assert_eq!(anchors, [0..2, 2..4, 4..5]);
        let error = read(20).err();
        let (what, offset, needed, left) = ("chunk index", 0, 21, 20);
        assert_eq!(error, Some(DecodeError::Truncated { part: PART, what, offset, needed, left }));
    }
}
