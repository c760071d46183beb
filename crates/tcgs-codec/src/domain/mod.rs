//! The types that all layers share: cameras, frames, anchors, options, metrics.
//!
//! No I/O here, no random numbers and no time. Constructors refuse invalid values (non-finite poses, zero focal lengths, empty images), so
//! other layers need not check them.

pub mod anchors;
pub mod camera;
pub mod camera_path;
mod camera_search;
mod choice;
pub mod choices;
pub mod context_model;
pub mod conventions;
pub mod convergence;
mod crop;
pub mod digest;
pub mod evenly_spaced;
pub mod exposure;
pub mod format;
pub mod gaussians;
pub mod harmonics;
pub mod held_out;
pub mod image;
pub mod memory;
mod metadata;
pub mod metrics;
mod metrics_table;
pub mod near_plane;
pub mod options;
pub mod orbit;
pub mod photograph;
pub mod problem;
pub mod progress;
pub mod read_options;
pub mod scene_frame;
pub mod scene_scale;
pub mod series;
pub mod view;
mod view_degree;

pub use anchors::{AnchorScene, DenseLayer, Lattice, Mlp, RenderNetworks};
pub use camera::{Camera, CameraError, Convention, Intrinsics, Pose};
pub use camera_search::{CameraModel, CameraSearchOptions, Matching};
pub use choices::{Choices, SizeBound, Widths};
pub use context_model::{
    AttributeGroup, ContextCandidates, ContextFrame, ContextKind, GroupNetworks, PlaneContext, Planes,
    UpLayer,
};
pub use conventions::{Conventions, LpipsNetwork};
pub use convergence::{Convergence, ValidationScore};
pub use crop::{Crop, CropError};
pub use digest::Digest;
pub use exposure::{Exposure, ExposureChoice, ExposureTrial};
pub use format::SceneFormat;
pub use gaussians::{GaussianScene, Scene};
pub use held_out::{HeldOut, HeldOutView};
pub use image::{Image, ImageError};
pub use memory::{Bytes, MemoryBudget, MemoryLimits};
pub use metadata::{
    MAX_LABEL_KEY, MAX_LABEL_VALUE, MAX_LABELS, MAX_NAME, Metadata, MetadataError, valid_name,
};
pub use metrics::{
    ByteBudget, ByteCounts, CodingEfficiency, CodingStages, ColorFitScores, CropCost, CurvePoint,
    GroupQstepLog2, JobMetrics, PhaseSeconds, RenderingError, Scores, ViewScore,
};
pub use metrics_table::{csv_cell, metrics_columns};
pub use near_plane::NearPlane;
pub use options::{
    Background, Component, ModelKind, OptionError, Preset, TRAIN_OPTIONS, TrainOption, TrainOptions, Until,
    Voxel,
};
pub use orbit::Orbit;
pub use photograph::{Photograph, PhotographError, PixelSource};
pub use problem::{Problem, ProblemType};
pub use progress::{CancelFlag, Phase, PoseProgress, PoseStage, Preview, Progress};
pub use read_options::{ExifOrientation, HoldOut, MaskMode, MaskSource, MaxWidth, ReadOptions};
pub use scene_frame::SceneFrame;
pub use scene_scale::SceneScale;
pub use series::{SERIES_POINTS, SeriesPoint, series_bucket, with_cumulative_seconds};
pub use view::{CameraView, View, ViewError, ViewRequest};
pub use view_degree::ViewDegree;
