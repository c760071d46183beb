//! The vocabulary of the project: cameras, frames, anchors, options, jobs, metrics, time.
//!
//! Nothing here does I/O, draws random numbers or reads a clock by itself. Constructors refuse values that the
//! rest of the program must never meet (non-finite poses, zero focal lengths, empty images), so every other
//! layer may rely on them.

#[cfg(feature = "service")]
pub mod access;
pub mod anchors;
pub mod camera;
pub mod camera_path;
#[cfg(feature = "service")]
pub mod clock;
pub mod context;
pub mod conventions;
pub mod digest;
pub mod distance_unit;
#[cfg(feature = "service")]
pub mod entropy;
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
pub mod metrics;
pub mod near;
pub mod options;
pub mod orbit;
#[cfg(feature = "service")]
pub mod outbound;
pub mod photograph;
pub mod problem;
pub mod progress;
pub mod scene;
pub mod series;
pub mod view;
#[cfg(feature = "service")]
pub mod webhook;
#[cfg(feature = "service")]
pub mod webhook_secret;

#[cfg(feature = "service")]
pub use access::{Caller, DEFAULT_MAX_PRIORITY, KeyLimits, MAX_PRIORITY, Scope};
pub use anchors::{AnchorScene, DenseLayer, Lattice, Mlp, RenderNetworks};
pub use camera::{Camera, CameraError, Convention, Intrinsics, Pose};
#[cfg(feature = "service")]
pub use clock::{Clock, ManualClock, SystemClock};
pub use context::{
    AttributeGroup, ContextCandidates, ContextFrame, ContextKind, GroupNetworks, PlaneContext, Planes,
    UpLayer,
};
pub use conventions::{Conventions, LpipsNetwork};
pub use digest::Digest;
pub use distance_unit::DistanceUnit;
#[cfg(feature = "service")]
pub use entropy::{Entropy, EntropyError, SystemEntropy};
pub use format::SceneFormat;
pub use gaussians::{GaussianScene, Scene};
pub use held_out::{HeldOut, HeldOutView};
#[cfg(feature = "service")]
pub use id::{DeliveryId, EndpointId, JobId, KeyId, SceneId, UploadId};
pub use image::{Image, ImageError};
#[cfg(feature = "service")]
pub use job::{Event, EventKind, Job, JobState};
#[cfg(feature = "service")]
pub use key::{ApiKey, KeyHash, MalformedKey};
pub use memory::{Bytes, MemoryBudget, MemoryLimits};
pub use metrics::{
    ByteBudget, ByteCounts, CodingEfficiency, CurvePoint, GroupOctaves, JobMetrics, PhaseSeconds, Scores,
    ViewScore,
};
pub use near::NearPlane;
pub use options::{Background, Component, ModelKind, OptionError, Preset, TrainOptions, Voxel};
pub use orbit::Orbit;
#[cfg(feature = "service")]
pub use outbound::{OutboundFault, OutboundPolicy};
pub use photograph::{Photograph, PhotographError, PixelSource};
pub use problem::{Problem, ProblemType};
pub use progress::{CancelFlag, Phase, Progress};
pub use scene::{Dataset, DatasetSummary, Frame, Layout, NamedCamera, PointCloud, Split};
pub use series::{SERIES_POINTS, SeriesPoint, in_running_time, series_bucket};
pub use view::{View, ViewError, ViewRequest};
#[cfg(feature = "service")]
pub use webhook::WebhookEvent;
#[cfg(feature = "service")]
pub use webhook_secret::WebhookSecret;
