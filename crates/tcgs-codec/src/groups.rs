//! Codes an attribute group by a model, whole or in part, for the encoder's search.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    attributes::{self, CodedGroup, is_coded},
    bytes::Writer,
    context::{AnchorContext, BaseModel, ContextNetwork, GroupModel, GroupRegression, Predictions},
    error::EncodeError,
    fit,
    quantize::Quantizer,
    range::StreamEncoder,
    shape::SceneShape,
};

/// Codes one attribute group of a scene.
#[derive(Debug, Clone, Copy)]
pub(super) struct GroupCoder<'a> {
    pub(super) quantizer: Quantizer<'a>,
    pub(super) shape: SceneShape,
    /// `[N][K]`, in file order.
    pub(super) masks: &'a [bool],
    /// Anchors of each chunk.
    pub(super) chunks: &'a [Range<usize>],
    /// Inputs of the networks for every anchor.
    pub(super) anchors: &'a AnchorContext,
}

/// A chunk of a group: its stream, integers and step indices.
type CodedChunk = (Vec<u8>, Vec<i32>, Vec<i8>);

impl GroupCoder<'_> {
    /// Channels of the group.
    pub(super) fn channels(&self) -> usize {
        self.shape.channels(self.quantizer.attribute)
    }

    /// Whether a symbol is in the file.
    pub(super) fn is_coded(&self, anchor: usize, channel: usize) -> bool {
        is_coded(self.masks, self.shape, anchor, self.quantizer.attribute, channel)
    }

    /// Codes the group with the best table for each channel and steps of index `step_index`.
    pub(super) fn with_tables(&self, step_index: i8) -> Result<CodedGroup, EncodeError> {
        let _stage = tracing::debug_span!("symbols").entered();
        let channels = self.channels();
        let mut symbols = vec![0; self.shape.anchors * channels];
        symbols
            .par_chunks_mut(channels)
            .enumerate()
            .with_min_len(1024)
            .try_for_each(|(anchor, row)| self.quantizer.row(anchor, step_index, row))?;
        let fitted = (0..channels)
            .into_par_iter()
            .map(|channel| {
                let anchors = (0..self.shape.anchors).filter(|anchor| self.is_coded(*anchor, channel));
                fit::fit(anchors.map(|anchor| symbols[anchor * channels + channel]).collect())
            })
            .collect();
        let model = GroupModel::from(BaseModel::Static { step_index, channels: fitted });
        let streams = self.streams(&model, &symbols);
        Ok(CodedGroup { model, streams, symbols, step_indices: vec![step_index; self.shape.anchors] })
    }

    /// Codes a group's symbols once more, with each channel in the light of those before it.
    pub(super) fn with_regression(&self, coded: &CodedGroup, regression: GroupRegression) -> CodedGroup {
        let _stage = tracing::debug_span!("regression").entered();
        let model = GroupModel { base: coded.model.base.clone(), regression: Some(regression) };
        let streams = self.streams(&model, &coded.symbols);
        let (symbols, step_indices) = (coded.symbols.clone(), coded.step_indices.clone());
        CodedGroup { model, streams, symbols, step_indices }
    }

    /// Codes `symbols`, that is `[N][channels]`, by a model.
    fn streams(&self, model: &GroupModel, symbols: &[i32]) -> Vec<Vec<u8>> {
        let channels = self.channels();
        let encode = |chunk: &Range<usize>| {
            let mut stream = StreamEncoder::new();
            let mut predictions = model.predictions(self.anchors);
            for anchor in chunk.clone() {
                predictions.begin(anchor);
                let row = &symbols[anchor * channels..(anchor + 1) * channels];
                self.encode_row(anchor, row, &mut predictions, &mut stream);
            }
            stream.finish()
        };
        self.chunks.par_iter().map(encode).collect()
    }

    /// Codes the group by a network.
    pub(super) fn with_network(&self, network: ContextNetwork) -> Result<CodedGroup, EncodeError> {
        let _stage = tracing::debug_span!("predicted symbols").entered();
        let model = GroupModel::from(BaseModel::Network(network));
        let chunks: Vec<CodedChunk> =
            self.chunks.par_iter().map(|chunk| self.encode_chunk(chunk, &model)).collect::<Result<_, _>>()?;
        let mut coded = CodedGroup {
            model,
            streams: Vec::with_capacity(chunks.len()),
            symbols: Vec::with_capacity(self.shape.anchors * self.channels()),
            step_indices: Vec::with_capacity(self.shape.anchors),
        };
        for (stream, symbols, step_indices) in chunks {
            coded.streams.push(stream);
            coded.symbols.extend(symbols);
            coded.step_indices.extend(step_indices);
        }
        Ok(coded)
    }

    /// Bytes of all streams, extrapolated from every `stride`-th chunk.
    pub(super) fn estimate(&self, network: &ContextNetwork, stride: usize) -> Result<u64, EncodeError> {
        let model = GroupModel::from(BaseModel::Network(network.clone()));
        let chunks: Vec<&Range<usize>> = self.chunks.iter().step_by(stride.max(1)).collect();
        let anchors: usize = chunks.iter().map(|chunk| chunk.len()).sum();
        let bytes: u64 = chunks
            .into_par_iter()
            .map(|chunk| self.encode_chunk(chunk, &model).map(|(stream, ..)| stream.len() as u64))
            .try_reduce(|| 0, |a, b| Ok(a + b))?;
        Ok(bytes * self.shape.anchors as u64 / anchors.max(1) as u64)
    }

    /// Quantizes by the steps that the model chooses, and codes.
    fn encode_chunk(&self, chunk: &Range<usize>, model: &GroupModel) -> Result<CodedChunk, EncodeError> {
        let channels = self.channels();
        let mut symbols = vec![0; chunk.len() * channels];
        let mut step_indices = Vec::with_capacity(chunk.len());
        let mut stream = StreamEncoder::new();
        let mut predictions = model.predictions(self.anchors);
        for (anchor, row) in chunk.clone().zip(symbols.chunks_mut(channels)) {
            let step_index = predictions.begin(anchor);
            self.quantizer.row(anchor, step_index, row)?;
            self.encode_row(anchor, row, &mut predictions, &mut stream);
            step_indices.push(step_index);
        }
        Ok((stream.finish(), symbols, step_indices))
    }

    fn encode_row(
        &self,
        anchor: usize,
        row: &[i32],
        predictions: &mut Predictions<'_>,
        stream: &mut StreamEncoder,
    ) {
        for (channel, symbol) in row.iter().enumerate() {
            let coded = self.is_coded(anchor, channel);
            if coded {
                predictions.next(channel).encode(stream, *symbol);
            }
            predictions.observe(channel, coded.then_some(*symbol));
        }
    }
}

impl CodedGroup {
    /// Its network, if it has one.
    pub(super) fn network(&self) -> Option<&ContextNetwork> {
        match &self.model.base {
            BaseModel::Static { .. } => None,
            BaseModel::Network(network) => Some(network),
        }
    }

    /// Bytes in the attributes section, but for the chunk index, and of the regression.
    pub(super) fn bytes(&self) -> u64 {
        let mut writer = Writer::new();
        attributes::write_parameters(&self.model.base, &mut writer);
        self.model.regression.iter().for_each(|regression| regression.write(&mut writer));
        writer.into_bytes().len() as u64 + self.streams.iter().map(|stream| stream.len() as u64).sum::<u64>()
    }
}
