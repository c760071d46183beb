//! What the decoder expects of each symbol: the seam between attribute coding and the model of the attributes.
//!
//! Encoder and decoder ask the same model the same questions in the same order. A model may use whatever the
//! decoder has before the attributes (manifest, cells, masks, its own parameters) and nothing else.

use std::ops::Range;

use crate::{
    codec::{
        bytes::{Reader, Writer},
        decode::reserved,
        error::DecodeError,
        fit,
        quantise::Symbols,
        symbols::Distribution,
    },
    domain::anchors::SCALINGS_PER_ANCHOR,
};

/// A kind of attribute, in the order in which a chunk stores its streams.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::codec) enum Attribute {
    /// F channels.
    Features,
    /// Six channels.
    Scalings,
    /// 3 K channels: offset-major, then axis.
    Offsets,
}

impl Attribute {
    pub(in crate::codec) const ALL: [Self; 3] =
        [Attribute::Features, Attribute::Scalings, Attribute::Offsets];
}

/// The widths of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::codec) struct Shape {
    pub(in crate::codec) anchors: usize,
    pub(in crate::codec) feature_dim: usize,
    pub(in crate::codec) offsets_per_anchor: usize,
}

impl Shape {
    /// Channels of an attribute.
    pub(in crate::codec) fn channels(self, attribute: Attribute) -> usize {
        match attribute {
            Attribute::Features => self.feature_dim,
            Attribute::Scalings => SCALINGS_PER_ANCHOR,
            Attribute::Offsets => 3 * self.offsets_per_anchor,
        }
    }
}

/// Which (mean, scale) a symbol has.
pub(in crate::codec) trait SymbolModel: Sync {
    /// The distribution of the symbol of `anchor` (in file order) in one channel of `attribute`.
    fn distribution(&self, anchor: usize, attribute: Attribute, channel: usize) -> Distribution;
}

/// One distribution a channel, the same for every anchor.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::codec) struct ChannelModel([Vec<Distribution>; 3]);

impl SymbolModel for ChannelModel {
    fn distribution(&self, _anchor: usize, attribute: Attribute, channel: usize) -> Distribution {
        self.0[attribute as usize][channel]
    }
}

impl ChannelModel {
    /// Fits each channel to its symbols.
    pub(in crate::codec) fn fit(symbols: &Symbols, shape: Shape) -> Self {
        use rayon::prelude::*;
        Self(Attribute::ALL.map(|attribute| {
            let channels = shape.channels(attribute);
            (0..channels)
                .into_par_iter()
                .map(|channel| {
                    let anchors = 0..shape.anchors;
                    let kept = |anchor: &usize| {
                        attribute != Attribute::Offsets
                            || symbols.masks[anchor * shape.offsets_per_anchor + channel / 3]
                    };
                    let all = symbols.of(attribute);
                    fit::fit(anchors.filter(kept).map(|anchor| all[anchor * channels + channel]).collect())
                })
                .collect()
        }))
    }

    /// Stores the distributions of every attribute in turn.
    pub(in crate::codec) fn write(&self, writer: &mut Writer) {
        self.0.iter().flatten().for_each(|distribution| fit::write(*distribution, writer));
    }

    /// Reads what [`ChannelModel::write`] stored, with the place of each attribute's part.
    pub(in crate::codec) fn read(
        reader: &mut Reader<'_>,
        shape: Shape,
    ) -> Result<(Self, [Range<usize>; 3]), DecodeError> {
        let mut model = Self([Vec::new(), Vec::new(), Vec::new()]);
        let mut places = [0..0, 0..0, 0..0];
        for attribute in Attribute::ALL {
            let start = reader.position();
            let channels = shape.channels(attribute);
            let distributions = &mut model.0[attribute as usize];
            *distributions = reserved("channels", channels)?;
            for _ in 0..channels {
                distributions.push(fit::read(reader)?);
            }
            places[attribute as usize] = start..reader.position();
        }
        Ok((model, places))
    }
}

impl Symbols {
    /// The integers of one attribute.
    pub(in crate::codec) fn of(&self, attribute: Attribute) -> &[i32] {
        match attribute {
            Attribute::Features => &self.features,
            Attribute::Scalings => &self.scalings,
            Attribute::Offsets => &self.offsets,
        }
    }
}
