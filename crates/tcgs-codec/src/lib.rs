//! The `.tcgs` file: [`decode`], [`inspect`], [`encode`]. Depends on [`domain`] only: no GPU, no I/O, no async.
//!
//! ```
//! use tcgs_codec::{DecodeError, DecodeLimits, decode};
//!
//! # let file = include_bytes!("../../../tests/golden/shell_v1.tcgs");
//! let decoded = decode(file, &DecodeLimits::default())?;
//! let scene = &decoded.scene;
//! assert_eq!(scene.features.len(), scene.len() * scene.feature_dim);
//! let [x, y, z] = scene.lattice.position(scene.cells[0]); // of the first anchor, in world units
//!
//! // A damaged file is an error that says what is wrong and where.
//! let error = decode(&file[..1000], &DecodeLimits::default()).unwrap_err();
//! assert!(matches!(error, DecodeError::FileLength { actual: 1000, .. }));
//! # Ok::<(), DecodeError>(())
//! ```
//!
//! **Result.** [`Decoded`] holds the [`AnchorScene`] (anchors in Morton order, all arrays anchor-major) and the [`Manifest`].
//! Positions and scalings are in the world units of the training cameras, [`Manifest::world_frame`] names the axes;
//! scalings are linear and multiply the offsets. Opacities, colors and covariances of the Gaussians come from the scene's
//! three networks, given an anchor's features and the view direction. `docs/DECODER.md` walks through it.
//!
//! **Untrusted bytes.** A count is checked against the bytes left and the caller's [`DecodeLimits`] before anything is
//! allocated, and no input makes the decoder panic. A file is accepted as a whole or not at all.
//!
//! **Reproducible.** `FORMAT.md` specifies the file. Between its bytes and its symbols there are integers only, so a file
//! decodes to the same bits on every machine and with any number of threads; attributes are one exact f32 multiplication
//! away from their symbols. [`decode`] compares the result with the hash that the encoder stored. Threads come from
//! rayon's current pool; where the target has no threads, everything runs on the calling one.

#![warn(missing_docs)]

mod adaptive;
mod alloc;
mod attributes;
mod bytes;
mod container;
pub mod context;
mod decode;
mod digest;
pub mod domain;
mod efficiency;
mod encode;
mod error;
mod explain;
mod fit;
mod gaussian;
mod gaussian_constants;
mod groups;
mod inspect;
mod manifest;
mod masks;
mod morton;
mod networks;
mod positions;
mod precision;
mod quantize;
mod range;
mod regression_fit;
mod search;
mod sections;
mod shape;
mod stored_steps;
mod symbols;
mod view;

use serde::{Deserialize, Serialize};

use crate::domain::{AnchorScene, Background, ByteCounts, Digest};

pub use context::{ContextChoice, ContextSearch, ContextSettings, GroupChoice, RegressionSearch};
pub use decode::{DecodeLimits, Decoded, decode};
pub use digest::decode_digest;
pub use efficiency::{Efficiency, NetworkBits, efficiency};
pub use encode::encode;
pub use error::{DecodeError, EncodeError};
pub use inspect::{ByteGroup, ByteRange, Inspection, SectionReport, inspect};
pub use manifest::{ColorSpace, GroupContext, GroupCosts, Manifest, QuantSteps, WorldFrame};
pub use positions::position_bytes;
pub use stored_steps::{StoredSteps, stored_steps};

/// How a file was made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Program and version.
    pub generator: String,
    /// Digest of the dataset.
    pub dataset: Option<Digest>,
    /// Adapter that trained.
    pub adapter: Option<String>,
    /// Training options as JSON, and as `choices` what the run chose for its dataset ([`crate::domain::choices::Choices`]).
    pub settings: serde_json::Value,
}

impl Provenance {
    /// Of files that are only measured.
    #[must_use]
    pub fn unstated() -> Self {
        Self { generator: String::new(), dataset: None, adapter: None, settings: serde_json::Value::Null }
    }
}

/// How finely attributes are quantized.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodeSettings {
    /// Background that the scene was trained on.
    pub background: Background,
    /// Step of features (published 1).
    pub feature_step: f32,
    /// Step of linear scalings, as a fraction of the voxel size.
    pub scaling_step: f32,
    /// Step of offsets (published 0.2).
    pub offset_step: f32,
    /// How to choose contexts among the candidates, if there are any.
    pub context: ContextSettings,
    /// Stored in the manifest.
    pub provenance: Provenance,
}

/// A written file and its decoded content.
#[derive(Debug, Clone)]
pub struct Encoded {
    /// The file.
    pub bytes: Vec<u8>,
    /// Exactly what [`decode`] returns for `bytes`.
    pub scene: AnchorScene,
    /// SHA-256 of the decoded attributes.
    pub decode_sha256: Digest,
    /// Bytes by part.
    pub byte_counts: ByteCounts,
    /// The contexts that were used.
    pub context: ContextChoice,
}
