//! The metrics of a finished job, as the API returns them.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Background, Conventions, Convergence, Crop, Digest, ExposureChoice, LpipsNetwork, SceneFrame};

/// Image quality of one view, from 8-bit images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewScore {
    /// Frame name.
    pub name: String,
    /// dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// Perceptual distance; null without weights, or for an image too small for the network.
    pub lpips: Option<f64>,
}

/// Image quality over a set of views, from 8-bit images: the mean over views of each view's figure.
///
/// PSNR pools the squared error over a view's three channels; SSIM uses an 11x11 Gaussian window (sigma 1.5)
/// with zero padding (METHOD.md §1.2).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// dB, or null without views.
    pub psnr: Option<f64>,
    /// Structural similarity, or null without views.
    pub ssim: Option<f64>,
    /// Perceptual distance; null unless network weights are supplied and every view has a figure.
    pub lpips: Option<f64>,
    /// The network of `lpips`, and null with it.
    pub lpips_network: Option<LpipsNetwork>,
    /// How many views were measured.
    pub views: usize,
    /// The figures of each view, in the order of the dataset.
    #[serde(default)]
    pub per_view: Vec<ViewScore>,
}

/// Held-out views with and without a color correction, over the right halves that count (METHOD.md §1.2): the correction is the affine
/// one that fits a view's left half best. Means over views, of 8-bit images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ColorFitScores {
    /// Held-out views measured: those with pixels that count in both halves.
    pub views: usize,
    /// PSNR of the right halves as rendered, in dB.
    pub psnr: f64,
    /// PSNR of the right halves with the correction, in dB.
    pub corrected_psnr: f64,
}

impl fmt::Display for ColorFitScores {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "PSNR {:.2} dB over right halves, {:.2} dB with a color correction fitted to left halves",
            self.psnr, self.corrected_psnr
        )
    }
}

/// Where the bytes of the file go; the parts add up to `total`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ByteCounts {
    /// The whole file.
    pub total: u64,
    /// Anchor cells.
    pub positions: u64,
    /// Render networks, networks and regressions of the context.
    pub networks: u64,
    /// Context planes.
    pub planes: u64,
    /// Offset masks.
    pub masks: u64,
    /// Anchor features.
    pub features: u64,
    /// Anchor scalings.
    pub scalings: u64,
    /// Offsets.
    pub offsets: u64,
    /// Everything else: header, section table, manifest, checksums.
    pub container: u64,
}

impl ByteCounts {
    /// The parts of a file, in the order in which tables list them.
    #[must_use]
    pub fn parts(&self) -> [(&'static str, u64); 8] {
        [
            ("container", self.container),
            ("networks", self.networks),
            ("planes", self.planes),
            ("positions", self.positions),
            ("masks", self.masks),
            ("features", self.features),
            ("scalings", self.scalings),
            ("offsets", self.offsets),
        ]
    }
}

/// Wall-clock seconds by phase.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PhaseSeconds {
    /// Reading and checking the dataset.
    pub ingest: f64,
    /// Training.
    pub train: f64,
    /// Encoding.
    pub encode: f64,
    /// Decoding.
    pub decode: f64,
}

/// Base-2 logarithms of quantization steps by attribute group.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct GroupQstepLog2 {
    /// Of anchor features.
    pub features: f64,
    /// Of anchor scalings.
    pub scalings: f64,
    /// Of offsets.
    pub offsets: f64,
}

/// How a file was made to fit its target size.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ByteBudget {
    /// Bytes that the file may have.
    pub max_bytes: u64,
    /// Bytes that it would have had without a target size.
    #[serde(alias = "free_bytes")]
    pub unconstrained_bytes: u64,
    /// Base-2 logarithm of how much coarser quantization steps became, averaged over the anchors.
    #[serde(alias = "coarser_octaves")]
    pub qstep_log2: GroupQstepLog2,
    /// Gaussians pruned to fit.
    pub gaussians_dropped: u64,
}

/// What a crop saved and cost: the delivered file against that of the whole scene, encoded with the same options without a target size.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CropCost {
    /// The region.
    pub region: Crop,
    /// Gaussians that were removed.
    pub gaussians_removed: u64,
    /// Bytes that the file of the whole scene has more; fewer if negative.
    pub saved_bytes: i64,
    /// Held-out PSNR in dB by which the file of the whole scene is better; null without held-out views.
    pub lost_psnr: Option<f64>,
}

impl fmt::Display for CropCost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { gaussians_removed, saved_bytes, lost_psnr, .. } = self;
        write!(f, "saves {saved_bytes} bytes by {gaussians_removed} Gaussians")?;
        match lost_psnr {
            Some(lost) => write!(f, ", costs {lost:.2} dB of held-out PSNR"),
            None => Ok(()),
        }
    }
}

/// One point of a rate-distortion curve: a branch of the run with its own `lambda`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// The weight.
    pub lambda: f64,
    /// Of the branch's file.
    pub bytes: u64,
    /// Held-out PSNR of that file in dB, or null without held-out views.
    pub psnr: Option<f64>,
    /// Held-out SSIM.
    pub ssim: Option<f64>,
    /// Held-out LPIPS, as in `test`.
    pub lpips: Option<f64>,
    /// Its offsets that make a Gaussian.
    pub gaussians: u64,
    /// SHA-256 of the file.
    pub sha256: Digest,
}

/// Coding efficiency of a file's attributes as ratios of bytes; 1 is ideal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CodingEfficiency {
    /// Bytes in the file over the sum of -log2 p by the integer model that codes them.
    #[serde(alias = "over_ideal")]
    pub entropy_overhead: f64,
    /// That sum over the same by the float networks before conversion to integers; null if no group has one.
    pub over_floats: Option<f64>,
}

/// Held-out PSNR of one scene at each stage of its way into a file, in dB, over the same views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CodingStages {
    /// Held-out views measured, evenly spread.
    pub views: usize,
    /// Attributes and networks as trained, in floats.
    pub floats: f64,
    /// Uniform noise as wide as each quantization step in place of rounding, float networks.
    pub noise: f64,
    /// Attributes as the file has them, float networks.
    pub rounded: f64,
    /// The decoded file: attributes and networks as it has them.
    pub decoded: f64,
}

/// How far the f32 renderer is from the f64 reference for the decoded scene, of colors from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RenderingError {
    /// Held-out views compared, evenly spread.
    pub views: usize,
    /// Width and height of the first in pixels; views are compared at a reduced size.
    pub size: [u32; 2],
    /// Root of the mean squared difference.
    pub rmse: f64,
    /// The largest difference.
    pub max: f64,
    /// The same root for the reference itself without the cut-offs of blending: what skipping faint contributions costs.
    pub cutoff_rmse: f64,
}

/// All figures of a finished job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JobMetrics {
    /// Held-out views of the DECODED file.
    pub test: Scores,
    /// Training views of the decoded file (a sample of them, see `views`).
    pub train: Scores,
    /// Bytes by section.
    pub bytes: ByteCounts,
    /// Seconds by phase.
    pub seconds: PhaseSeconds,
    /// Training steps.
    pub steps: u64,
    /// Training steps per second, over the whole training phase.
    pub steps_per_second: f64,
    /// Mean pixels of a training photograph; null for jobs of versions that did not record it.
    #[serde(default)]
    pub view_pixels: Option<u64>,
    /// Anchors in the file.
    pub anchors: u64,
    /// Offsets in the file that make a Gaussian.
    pub gaussians: u64,
    /// Held-out PSNR of the scene with attributes and networks as floats, before anything was rounded.
    pub psnr_before_quantisation: Option<f64>,
    /// SHA-256 of the decoded attributes.
    pub decode_sha256: Digest,
    /// Adapter and driver that trained.
    pub adapter: String,
    /// Background that renders and images were composited on.
    pub background: Background,
    /// How image quality was measured.
    #[serde(default)]
    pub conventions: Conventions,
    /// How `max_bytes` was met; null if it was not set.
    pub byte_budget: Option<ByteBudget>,
    /// How `until=converged` went in a run of an earlier version; null in all others.
    pub convergence: Option<Convergence>,
    /// Coding efficiency; null if nothing was entropy-coded.
    pub coding: Option<CodingEfficiency>,
    /// PSNR at each stage of coding; null for files of floats and without held-out views.
    pub stages: Option<CodingStages>,
    /// The renderer against the f64 reference; null where it was not compared.
    pub rendering: Option<RenderingError>,
    /// Where the scene's own coordinates are in the world; null for jobs of versions that trained in world coordinates.
    #[serde(default)]
    pub frame: Option<SceneFrame>,
    /// Held-out views with and without a color correction; null without such views and for jobs of versions without it.
    #[serde(default)]
    pub color_fit: Option<ColorFitScores>,
    /// Whether color corrections were learnt; null for jobs of versions without them.
    #[serde(default)]
    pub exposure: Option<ExposureChoice>,
    /// What the crop saved and cost; null without one.
    #[serde(default)]
    pub crop: Option<CropCost>,
    /// The points of `rd_curve` in the order given; the other metrics are those of the first. Else empty.
    #[serde(default)]
    pub rd_curve: Vec<CurvePoint>,
}
