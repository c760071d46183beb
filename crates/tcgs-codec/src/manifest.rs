//! The manifest section: what a decoder must know before any payload, and the file's provenance.

use serde::{Deserialize, Serialize};

use super::{
    Provenance,
    bytes::{Reader, Writer},
    context::quant_steps::{self, MAX_STEP_INDEX},
    error::{EncodeError, Result},
    shape::{Attribute, SceneShape},
    symbols::MAX_SYMBOL,
};
use crate::domain::{Background, Digest, Lattice, context_model::ContextKind};

const PART: &str = "manifest";

/// Widest feature of the format.
pub(super) const MAX_FEATURE_DIM: usize = 256;

/// Most offsets an anchor of the format.
pub(super) const MAX_OFFSETS: usize = 64;

/// Most anchors in a chunk.
const MAX_CHUNK: usize = 1 << 16;

/// Absolute quantization steps: a decoded value is an integer times its step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct QuantSteps {
    /// Of features.
    pub feature: f32,
    /// Of linear scalings, in world units.
    pub scaling: f32,
    /// Of offsets, in units of the first three scalings.
    pub offset: f32,
}

impl QuantSteps {
    /// The base step of a group.
    pub(super) fn of(self, attribute: Attribute) -> f32 {
        match attribute {
            Attribute::Features => self.feature,
            Attribute::Scalings => self.scaling,
            Attribute::Offsets => self.offset,
        }
    }
}

/// Bytes that a group takes in the file when it is coded in one way or another: its attributes, and its network. None of
/// what was not tried. Planes come on top, once for all groups.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GroupCosts {
    /// With one table a channel.
    pub tables: Option<u64>,
    /// With the best network that is given the position alone.
    pub position: Option<u64>,
    /// With the best network that is given samples of the planes too.
    pub tri_plane: Option<u64>,
    /// With the best network that is given those of the neighbors too.
    pub tri_plane_knn: Option<u64>,
}

/// How an attribute group is predicted, and what else was tried.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GroupContext {
    /// Inputs of the group's network; `None` for tables.
    pub kind: Option<ContextKind>,
    /// Bytes of the alternatives that the encoder compared.
    pub bytes: GroupCosts,
}

impl GroupContext {
    fn write(&self, writer: &mut Writer) {
        writer.u8(match self.kind {
            None => 0,
            Some(ContextKind::Position) => 1,
            Some(ContextKind::TriPlane) => 2,
            Some(ContextKind::TriPlaneKnn) => 3,
        });
        let GroupCosts { tables, position, tri_plane, tri_plane_knn } = self.bytes;
        [tables, position, tri_plane, tri_plane_knn]
            .iter()
            .for_each(|bytes| writer.varint(bytes.map_or(0, |bytes| bytes + 1)));
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self> {
        let kind = match reader.u8("context")? {
            0 => None,
            1 => Some(ContextKind::Position),
            2 => Some(ContextKind::TriPlane),
            3 => Some(ContextKind::TriPlaneKnn),
            other => return Err(reader.malformed("context", other)),
        };
        let mut cost = || Ok(reader.varint("bytes of a context")?.checked_sub(1));
        let bytes =
            GroupCosts { tables: cost()?, position: cost()?, tri_plane: cost()?, tri_plane_knn: cost()? };
        Ok(Self { kind, bytes })
    }
}

/// Color space of decoded colors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorSpace {
    /// Display-referred sRGB, blended as encoded values, as the training images were.
    Srgb,
}

/// The coordinate system of positions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WorldFrame {
    /// The dataset's own world; cameras look along +z of their own frame with y down (OpenCV).
    Dataset,
}

/// Counts, choices and provenance of a file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Anchors N.
    pub anchors: usize,
    /// Offsets that make a Gaussian.
    pub gaussians: usize,
    /// Width F of a feature.
    pub feature_dim: usize,
    /// Offsets K an anchor.
    pub offsets_per_anchor: usize,
    /// Anchors in a chunk; the last may have fewer.
    pub chunk_anchors: usize,
    /// Where cells are in the world.
    pub lattice: Lattice,
    /// Quantization steps.
    pub steps: QuantSteps,
    /// How features, scalings and offsets are predicted.
    pub contexts: [GroupContext; 3],
    /// Frame of the world.
    pub world_frame: WorldFrame,
    /// Color space.
    pub color_space: ColorSpace,
    /// Background that the scene was trained on.
    pub background: Background,
    /// SHA-256 of the decoded attributes, as [`super::decode_digest`] computes it.
    pub decode_sha256: Digest,
    /// How the file was made.
    pub provenance: Provenance,
}

impl Manifest {
    pub(super) fn shape(&self) -> SceneShape {
        SceneShape {
            anchors: self.anchors,
            feature_dim: self.feature_dim,
            offsets_per_anchor: self.offsets_per_anchor,
        }
    }

    /// Inputs of the groups' networks.
    pub(super) fn kinds(&self) -> [Option<ContextKind>; 3] {
        self.contexts.map(|context| context.kind)
    }

    /// The manifest section.
    pub(super) fn encode(&self) -> Vec<u8> {
        let mut writer = Writer::new();
        let counts =
            [self.anchors, self.gaussians, self.feature_dim, self.offsets_per_anchor, self.chunk_anchors];
        counts.iter().for_each(|count| writer.varint(*count as u64));
        writer.f32(self.lattice.voxel);
        self.lattice.origin.iter().for_each(|coordinate| writer.f32(*coordinate));
        writer.f32(self.steps.feature);
        writer.f32(self.steps.scaling);
        writer.f32(self.steps.offset);
        self.contexts.iter().for_each(|context| context.write(&mut writer));
        writer.u8(match self.world_frame {
            WorldFrame::Dataset => 0,
        });
        writer.u8(match self.color_space {
            ColorSpace::Srgb => 0,
        });
        writer.u8(match self.background {
            Background::Black => 0,
            Background::White => 1,
        });
        writer.raw(self.decode_sha256.as_bytes());
        let Provenance { generator, dataset, adapter, settings } = &self.provenance;
        writer.text(generator);
        writer.u8(u8::from(dataset.is_some()));
        dataset.iter().for_each(|digest| writer.raw(digest.as_bytes()));
        writer.u8(u8::from(adapter.is_some()));
        adapter.iter().for_each(|adapter| writer.text(adapter));
        writer.text(&settings.to_string());
        writer.into_bytes()
    }

    /// Reads the manifest section.
    pub(super) fn decode(section: &[u8]) -> Result<Self> {
        let mut reader = Reader::new(PART, section);
        let manifest = Self {
            anchors: reader.count("number of anchors", 1..=u32::MAX as usize)?,
            gaussians: reader.count("number of Gaussians", 1..=usize::MAX)?,
            feature_dim: reader.count("feature width", 1..=MAX_FEATURE_DIM)?,
            offsets_per_anchor: reader.count("offsets per anchor", 1..=MAX_OFFSETS)?,
            chunk_anchors: reader.count("anchors in a chunk", 1..=MAX_CHUNK)?,
            lattice: Lattice {
                voxel: reader.f32("voxel")?,
                origin: [reader.f32("origin")?, reader.f32("origin")?, reader.f32("origin")?],
            },
            steps: QuantSteps {
                feature: reader.f32("feature step")?,
                scaling: reader.f32("scaling step")?,
                offset: reader.f32("offset step")?,
            },
            contexts: [
                GroupContext::read(&mut reader)?,
                GroupContext::read(&mut reader)?,
                GroupContext::read(&mut reader)?,
            ],
            world_frame: match reader.u8("world frame")? {
                0 => WorldFrame::Dataset,
                other => return Err(reader.malformed("world frame", other)),
            },
            color_space: match reader.u8("color space")? {
                0 => ColorSpace::Srgb,
                other => return Err(reader.malformed("color space", other)),
            },
            background: match reader.u8("background")? {
                0 => Background::Black,
                1 => Background::White,
                other => return Err(reader.malformed("background", other)),
            },
            decode_sha256: Digest::from_bytes(reader.digest_bytes("decode hash")?),
            provenance: read_provenance(&mut reader)?,
        };
        reader.end()?;
        match manifest.check_numbers() {
            Ok(()) => Ok(manifest),
            Err(EncodeError::Setting { name, value }) => Err(reader.malformed(name, value)),
            Err(other) => Err(reader.malformed("a number", other)),
        }
    }

    /// Checks that every decoded position and value will be finite.
    pub(super) fn check_numbers(&self) -> Result<(), EncodeError> {
        let QuantSteps { feature, scaling, offset } = self.steps;
        let multipliers = [
            ("voxel", self.lattice.voxel),
            ("feature step", feature),
            ("scaling step", scaling),
            ("offset step", offset),
        ];
        // A group's step is at most that many octaves from its base step.
        let (finest, coarsest) = (quant_steps::factor(-MAX_STEP_INDEX), quant_steps::factor(MAX_STEP_INDEX));
        for (name, value) in multipliers {
            let usable =
                |value: f32| value.is_normal() && value > 0.0 && (value * MAX_SYMBOL as f32).is_finite();
            if !(usable(value * finest) && usable(value) && usable(value * coarsest)) {
                return Err(EncodeError::Setting { name, value });
            }
        }
        let reach = i32::MIN as f32 * self.lattice.voxel;
        match self.lattice.origin.iter().find(|value| !(reach - value.abs()).is_finite()) {
            None => Ok(()),
            Some(value) => Err(EncodeError::Setting { name: "origin", value: *value }),
        }
    }
}

fn read_provenance(reader: &mut Reader<'_>) -> Result<Provenance> {
    let generator = reader.text("generator")?.to_owned();
    let dataset = match flag(reader, "dataset flag")? {
        true => Some(Digest::from_bytes(reader.digest_bytes("dataset")?)),
        false => None,
    };
    let adapter = match flag(reader, "adapter flag")? {
        true => Some(reader.text("adapter")?.to_owned()),
        false => None,
    };
    let settings = reader.text("settings")?;
    let settings = serde_json::from_str(settings)
        .map_err(|error| reader.malformed("settings", format!("not JSON: {error}")))?;
    Ok(Provenance { generator, dataset, adapter, settings })
}

fn flag(reader: &mut Reader<'_>, what: &'static str) -> Result<bool> {
    match reader.u8(what)? {
        0 => Ok(false),
        1 => Ok(true),
        other => Err(reader.malformed(what, other)),
    }
}
