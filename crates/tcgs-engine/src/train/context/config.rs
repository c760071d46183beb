//! The sizes of a context model.

use crate::{
    domain::{AttributeGroup, ContextKind},
    train::ContextError,
};

/// Largest edge of a plane: a texel's coordinate is one byte.
const MAX_EDGE: usize = 256;

/// Sizes of planes, their latents and the layers between them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlaneConfig {
    /// Texels along the edge of a plane: a power of two of at most 256.
    pub edge: usize,
    /// Channels of a plane: a multiple of four.
    pub channels: usize,
    /// Layers down to the latents and as many up again, each of which halves or doubles the edge. With none, the latents are the
    /// planes in multiples of 1/16.
    pub layers: usize,
    /// Channels between two layers.
    pub hidden: usize,
    /// Channels of a latent; those of a plane where there are no layers.
    pub latents: usize,
}

impl PlaneConfig {
    /// Sizes for a scene of `anchors` anchors. Planes grow with the bytes that they can save: 0.3 kB of latents
    /// and 0.6 kB of layers for a few thousand anchors, ten times that for a hundred thousand.
    #[must_use]
    pub fn for_anchors(anchors: usize) -> Self {
        match anchors {
            0..16_384 => Self { edge: 32, channels: 4, layers: 2, hidden: 8, latents: 4 },
            16_384..65_536 => Self { edge: 64, channels: 8, layers: 2, hidden: 8, latents: 4 },
            _ => Self { edge: 64, channels: 8, layers: 2, hidden: 16, latents: 8 },
        }
    }

    /// The same planes, stored directly.
    #[must_use]
    pub fn without_layers(self) -> Self {
        Self { layers: 0, latents: self.channels, ..self }
    }

    /// Texels along the edge of a latent.
    #[must_use]
    pub fn latent_edge(&self) -> usize {
        self.edge >> self.layers
    }

    /// Values of the three planes.
    #[must_use]
    pub fn plane_values(&self) -> usize {
        3 * self.channels * self.edge * self.edge
    }

    /// Values of the three latents.
    #[must_use]
    pub fn latent_values(&self) -> usize {
        3 * self.latents * self.latent_edge() * self.latent_edge()
    }

    /// Channels from the planes to the latents.
    pub(super) fn level_channels(&self) -> Vec<usize> {
        let mut level_channels = vec![self.hidden; self.layers + 1];
        level_channels[0] = self.channels;
        if self.layers > 0 {
            level_channels[self.layers] = self.latents;
        }
        level_channels
    }

    fn check(&self) -> Result<(), ContextError> {
        let Self { edge, channels, layers, hidden, latents } = *self;
        let error = |text: String| Err(ContextError::Config(text));
        if !edge.is_power_of_two() || !(2..=MAX_EDGE).contains(&edge) {
            return error(format!(
                "a plane's edge of {edge} texels is not a power of two from 2 to {MAX_EDGE}"
            ));
        }
        if channels == 0 || channels % 4 != 0 {
            return error(format!("{channels} channels of a plane are not a multiple of four"));
        }
        if layers >= edge.ilog2() as usize {
            return error(format!("{layers} halvings leave less than two texels of an edge of {edge}"));
        }
        if layers == 0 && latents != channels {
            return error(format!(
                "{latents} channels of a latent without layers, but {channels} of a plane"
            ));
        }
        if latents == 0 || (layers > 1 && hidden == 0) {
            return error("a layer without channels".to_owned());
        }
        Ok(())
    }
}

/// Sizes of a context model in training: one network a group on a common input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ContextConfig {
    /// The inputs of the networks.
    pub kind: ContextKind,
    /// Channels of each attribute group.
    pub channels: [usize; 3],
    /// Hidden values of each group's network.
    pub hidden: [usize; 3],
    /// The planes; ignored if the networks have none.
    pub planes: PlaneConfig,
}

impl ContextConfig {
    /// Sizes for a scene of `anchors` anchors whose attribute groups have `channels` channels.
    #[must_use]
    pub fn for_anchors(kind: ContextKind, channels: [usize; 3], anchors: usize) -> Self {
        let hidden = match anchors {
            0..4_096 => [16, 8, 16],
            4_096..65_536 => [32, 16, 32],
            _ => [64, 32, 64],
        };
        Self { kind, channels, hidden, planes: PlaneConfig::for_anchors(anchors) }
    }

    /// Inputs of a network.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.kind.inputs(self.planes.channels)
    }

    /// Inputs that are samples of planes: the first ones.
    #[must_use]
    pub fn sampled_inputs(&self) -> usize {
        self.kind.sampled() * 3 * self.planes.channels
    }

    /// First row of each group's outputs, then the rows of all.
    #[must_use]
    pub fn output_rows(&self) -> [usize; 4] {
        let mut rows = [0; 4];
        for (group, channels) in self.channels.iter().enumerate() {
            rows[group + 1] = rows[group] + AttributeGroup::outputs(*channels);
        }
        rows
    }

    /// Checks that the kernels support these sizes.
    ///
    /// # Errors
    /// [`ContextError::Config`] names the size that is out of range.
    pub fn check(&self) -> Result<(), ContextError> {
        if self.channels.contains(&0) || self.hidden.contains(&0) {
            return Err(ContextError::Config("a group without channels or hidden values".to_owned()));
        }
        if self.kind.sampled() > 0 { self.planes.check() } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHANNELS: [usize; 3] = [32, 6, 30];

    #[test]
    fn sizes_for_any_number_of_anchors_are_known_and_grow() {
        let mut last = 0;
        for anchors in [0, 100, 4_095, 5_000, 16_384, 70_000, 2_000_000] {
            for kind in [ContextKind::Position, ContextKind::TriPlane, ContextKind::TriPlaneKnn] {
                let config = ContextConfig::for_anchors(kind, CHANNELS, anchors);
                config.check().expect("known sizes");
                let mut plain = config;
                plain.planes = config.planes.without_layers();
                plain.check().expect("known sizes without layers");
                assert_eq!(plain.planes.latent_values(), plain.planes.plane_values());
            }
            let values = PlaneConfig::for_anchors(anchors).latent_values();
            assert!(values >= last, "{anchors} anchors have {values} latents");
            last = values;
        }
    }

    #[test]
    fn sizes_that_kernels_do_not_know_are_refused() {
        let good = PlaneConfig { edge: 16, channels: 4, layers: 2, hidden: 8, latents: 3 };
        let bad = [
            PlaneConfig { edge: 24, ..good },
            PlaneConfig { edge: 512, ..good },
            PlaneConfig { edge: 1, ..good },
            PlaneConfig { channels: 6, ..good },
            PlaneConfig { channels: 0, ..good },
            PlaneConfig { layers: 4, ..good },
            PlaneConfig { layers: 0, ..good },
            PlaneConfig { hidden: 0, ..good },
            PlaneConfig { latents: 0, ..good },
        ];
        let config = |planes| ContextConfig {
            kind: ContextKind::TriPlane,
            channels: CHANNELS,
            hidden: [4; 3],
            planes,
        };
        assert_eq!(config(good).check(), Ok(()));
        for planes in bad {
            assert!(config(planes).check().is_err(), "{planes:?}");
            let unused = ContextConfig { kind: ContextKind::Position, ..config(planes) };
            assert_eq!(unused.check(), Ok(()), "planes that are not used do not matter");
        }
        assert!(ContextConfig { hidden: [4, 0, 4], ..config(good) }.check().is_err());
    }
}
