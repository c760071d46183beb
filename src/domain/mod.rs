//! The types that all layers share: cameras, frames, anchors, options, jobs, metrics, time.
//!
//! No I/O here, and no random numbers or time except from injected sources. Constructors refuse invalid values (non-finite poses, zero
//! focal lengths, empty images), so other layers need not check them.

#[cfg(feature = "service")]
pub mod access;
pub mod anchors;
pub mod camera;
pub mod camera_path;
#[cfg(feature = "service")]
mod causes;
mod choice;
pub mod choices;
#[cfg(feature = "service")]
pub mod clock;
pub mod context_model;
pub mod conventions;
pub mod convergence;
pub mod dataset;
#[cfg(feature = "service")]
mod defaults;
pub mod digest;
#[cfg(feature = "service")]
pub mod exported_scene;
#[cfg(feature = "service")]
pub mod failure_point;
pub mod format;
pub mod gaussians;
pub mod harmonics;
pub mod held_out;
#[cfg(feature = "service")]
pub mod id;
pub mod image;
#[cfg(feature = "service")]
pub mod job;
#[cfg(feature = "service")]
pub mod key;
pub mod memory;
mod metadata;
pub mod metrics;
mod metrics_table;
pub mod near_plane;
pub mod options;
pub mod orbit;
#[cfg(feature = "service")]
pub mod outbound;
pub mod photograph;
pub mod problem;
pub mod progress;
#[cfg(feature = "service")]
pub mod random_source;
pub mod scene_frame;
pub mod scene_scale;
pub mod series;
pub mod spread;
pub mod view;
#[cfg(feature = "service")]
pub mod viewer_token;
#[cfg(feature = "service")]
pub mod webhook;
#[cfg(feature = "service")]
pub mod webhook_secret;

#[cfg(feature = "service")]
pub use access::{Caller, DEFAULT_MAX_PRIORITY, MAX_PRIORITY, ProjectLimits, Scope};
pub use anchors::{AnchorScene, DenseLayer, Lattice, Mlp, RenderNetworks};
pub use camera::{Camera, CameraError, Convention, Intrinsics, Pose};
#[cfg(feature = "service")]
pub use causes::{causes, is_no_space};
#[cfg(feature = "service")]
pub(crate) use choice::named_choice;
pub use choices::{Choices, ShortenedRun, SizeBound, Widths};
#[cfg(feature = "service")]
pub use clock::{Clock, ManualClock, SystemClock};
pub use context_model::{
    AttributeGroup, ContextCandidates, ContextFrame, ContextKind, GroupNetworks, PlaneContext, Planes,
    UpLayer,
};
pub use conventions::{Conventions, LpipsNetwork};
pub use convergence::{AsideScore, Convergence};
pub use dataset::{Dataset, DatasetSummary, ExifOrientation, Frame, Layout, NamedCamera, PointCloud, Split};
#[cfg(feature = "service")]
pub(crate) use defaults::with_defaults;
pub use digest::Digest;
#[cfg(feature = "service")]
pub use exported_scene::{ExportFidelity, ExportedScene};
#[cfg(feature = "service")]
pub use failure_point::FailurePoint;
pub use format::SceneFormat;
pub use gaussians::{GaussianScene, Scene};
pub use held_out::{HeldOut, HeldOutView};
#[cfg(feature = "service")]
pub use id::{DatasetId, DeliveryId, EndpointId, JobId, KeyId, ProjectId, UploadId};
pub use image::{Image, ImageError};
#[cfg(feature = "service")]
pub use job::{Event, EventKind, Job, JobState};
#[cfg(feature = "service")]
pub use key::{ApiKey, KeyHash, MalformedKey};
pub use memory::{Bytes, MemoryBudget, MemoryLimits};
pub use metadata::{
    MAX_LABEL_KEY, MAX_LABEL_VALUE, MAX_LABELS, MAX_NAME, Metadata, MetadataError, valid_name,
};
pub use metrics::{
    ByteBudget, ByteCounts, CodingEfficiency, CodingStages, CurvePoint, GroupQstepLog2, JobMetrics,
    PhaseSeconds, RenderingError, Scores, ViewScore,
};
pub use metrics_table::{csv_cell, metrics_columns};
pub use near_plane::NearPlane;
pub use options::{
    Background, Component, ModelKind, OptionError, Preset, TRAIN_OPTIONS, TrainOption, TrainOptions, Until,
    Voxel,
};
pub use orbit::Orbit;
#[cfg(feature = "service")]
pub use outbound::{OutboundError, OutboundPolicy};
pub use photograph::{Photograph, PhotographError, PixelSource};
pub use problem::{Problem, ProblemType};
pub use progress::{CancelFlag, Phase, Progress};
#[cfg(feature = "service")]
pub use random_source::{RandomError, RandomSource, SystemRandom};
pub use scene_frame::SceneFrame;
pub use scene_scale::SceneScale;
pub use series::{SERIES_POINTS, SeriesPoint, series_bucket, with_cumulative_seconds};
pub use view::{View, ViewError, ViewRequest};
#[cfg(feature = "service")]
pub use viewer_token::ViewerToken;
#[cfg(feature = "service")]
pub use webhook::WebhookEvent;
#[cfg(feature = "service")]
pub use webhook_secret::WebhookSecret;
