//! The attributes section: the model's parameters, a chunk index, then chunks that decode on their own.
//!
//! A chunk holds consecutive anchors in file order as three streams: features, scalings, offsets. Chunks are
//! coded in parallel; each is a function of its own bytes, so the result does not depend on the threads.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    bytes::{Reader, Writer},
    context::{Attribute, ChannelModel, Shape, SymbolModel},
    decode::reserved,
    error::DecodeError,
    quantise::Symbols,
    range::{StreamDecoder, StreamEncoder},
};

const PART: &str = "attributes";

/// Streams of a chunk, by attribute, as the errors name them.
const STREAMS: [&str; 3] = ["features", "scalings", "offsets"];

/// Fewest bytes of a chunk's index entry: three varints and a checksum.
const MIN_ENTRY: usize = 7;

/// The attributes section.
pub(super) fn encode(symbols: &Symbols, shape: Shape, chunk_anchors: usize) -> Vec<u8> {
    let model = ChannelModel::fit(symbols, shape);
    let chunks: Vec<[Vec<u8>; 3]> = ranges(shape.anchors, chunk_anchors)
        .into_par_iter()
        .map(|anchors| encode_chunk(symbols, shape, &model, anchors))
        .collect();
    let mut writer = Writer::new();
    model.write(&mut writer);
    for streams in &chunks {
        streams.iter().for_each(|stream| writer.varint(stream.len() as u64));
        writer.u32(crc32c::crc32c(&streams.concat()));
    }
    chunks.iter().flatten().for_each(|stream| writer.raw(stream));
    writer.into_bytes()
}

fn encode_chunk(
    symbols: &Symbols,
    shape: Shape,
    model: &impl SymbolModel,
    anchors: Range<usize>,
) -> [Vec<u8>; 3] {
    Attribute::ALL.map(|attribute| {
        let channels = shape.channels(attribute);
        let all = symbols.of(attribute);
        let mut stream = StreamEncoder::new();
        for anchor in anchors.clone() {
            for channel in 0..channels {
                if is_coded(&symbols.masks, shape, anchor, attribute, channel) {
                    let distribution = model.distribution(anchor, attribute, channel);
                    distribution.encode(&mut stream, all[anchor * channels + channel]);
                }
            }
        }
        stream.finish()
    })
}

/// Offsets that are masked off are not in the file.
fn is_coded(masks: &[bool], shape: Shape, anchor: usize, attribute: Attribute, channel: usize) -> bool {
    attribute != Attribute::Offsets || masks[anchor * shape.offsets_per_anchor + channel / 3]
}

fn ranges(anchors: usize, chunk_anchors: usize) -> Vec<Range<usize>> {
    (0..anchors).step_by(chunk_anchors).map(|start| start..(start + chunk_anchors).min(anchors)).collect()
}

/// The section taken apart but not decoded; all places are offsets within the section and tile it.
pub(super) struct Layout {
    pub(super) model: ChannelModel,
    /// Each attribute's model parameters.
    pub(super) parameters: [Range<usize>; 3],
    /// The chunk index.
    pub(super) index: Range<usize>,
    /// Each chunk's streams and checksum.
    pub(super) chunks: Vec<ChunkPlace>,
}

/// A chunk's place in the section.
pub(super) struct ChunkPlace {
    /// Anchors in file order.
    pub(super) anchors: Range<usize>,
    /// Features, scalings, offsets.
    pub(super) streams: [Range<usize>; 3],
    checksum: u32,
}

impl Layout {
    /// Reads parameters and index, and checks that the chunks fill the rest of the section.
    pub(super) fn read(section: &[u8], shape: Shape, chunk_anchors: usize) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(PART, section);
        let (model, parameters) = ChannelModel::read(&mut reader, shape)?;
        let index_start = reader.position();
        let count = shape.anchors.div_ceil(chunk_anchors);
        if count > reader.left() / MIN_ENTRY {
            return Err(DecodeError::Truncated {
                part: PART,
                what: "chunk index",
                offset: index_start,
                needed: count as u64 * MIN_ENTRY as u64,
                left: reader.left() as u64,
            });
        }
        let mut entries = reserved("chunk index", count)?;
        for _ in 0..count {
            let lengths = [
                reader.varint("length of features")?,
                reader.varint("length of scalings")?,
                reader.varint("length of offsets")?,
            ];
            entries.push((lengths, reader.u32("chunk checksum")?));
        }
        let index = index_start..reader.position();
        let mut chunks = reserved("chunk index", count)?;
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
        Ok(Self { model, parameters, index, chunks })
    }

    /// Decodes every chunk: features, scalings and offsets of all anchors.
    pub(super) fn decode(
        &self,
        section: &[u8],
        shape: Shape,
        masks: &[bool],
    ) -> Result<[Vec<i32>; 3], DecodeError> {
        let decoded: Vec<Result<[Vec<i32>; 3], DecodeError>> = self
            .chunks
            .par_iter()
            .enumerate()
            .map(|(number, chunk)| {
                let bytes = &section[chunk.streams[0].start..chunk.streams[2].end];
                let actual = crc32c::crc32c(bytes);
                if actual != chunk.checksum {
                    return Err(DecodeError::ChunkChecksum { chunk: number, stated: chunk.checksum, actual });
                }
                decode_chunk(section, shape, &self.model, chunk, masks)
            })
            .collect();
        let mut all = [Vec::new(), Vec::new(), Vec::new()];
        for attribute in Attribute::ALL {
            all[attribute as usize] = reserved("attributes", shape.anchors * shape.channels(attribute))?;
        }
        for chunk in decoded {
            for (all, part) in all.iter_mut().zip(chunk?) {
                all.extend(part);
            }
        }
        Ok(all)
    }
}

fn decode_chunk(
    section: &[u8],
    shape: Shape,
    model: &impl SymbolModel,
    chunk: &ChunkPlace,
    masks: &[bool],
) -> Result<[Vec<i32>; 3], DecodeError> {
    let mut decoded = [Vec::new(), Vec::new(), Vec::new()];
    for attribute in Attribute::ALL {
        let name = STREAMS[attribute as usize];
        let channels = shape.channels(attribute);
        let mut stream = StreamDecoder::new(name, &section[chunk.streams[attribute as usize].clone()])?;
        let mut symbols = reserved("attributes", chunk.anchors.len() * channels)?;
        for anchor in chunk.anchors.clone() {
            for channel in 0..channels {
                symbols.push(if is_coded(masks, shape, anchor, attribute, channel) {
                    model.distribution(anchor, attribute, channel).decode(&mut stream)?
                } else {
                    0
                });
            }
        }
        stream.finish()?;
        decoded[attribute as usize] = symbols;
    }
    match decoded[Attribute::Scalings as usize].iter().find(|symbol| **symbol < 1) {
        None => Ok(decoded),
        Some(symbol) => {
            Err(DecodeError::Malformed { part: STREAMS[1], what: "a scaling", value: symbol.to_string() })
        }
    }
}
