//! Types that the engine and the service share: those of [`tcgs_codec::domain`], datasets, time, and points of failure.

mod causes;
pub mod clock;
mod crop_region;
pub mod dataset;
mod exported_scene;
pub mod failure_point;
mod job_needs;
mod pixel_mask;
mod placement;

pub use causes::{causes, is_no_space};
pub use clock::{Clock, ManualClock, SystemClock};
pub use crop_region::CropRegion;
pub use dataset::{Dataset, DatasetSummary, Frame, Layout, NamedCamera, PointCloud, Split};
pub use exported_scene::{ExportFidelity, ExportedScene};
pub use failure_point::FailurePoint;
pub use job_needs::{JobNeeds, MemoryNeeds, ValueRange};
pub use pixel_mask::PixelMask;
pub use placement::{MAX_SCALE, Placement, PlacementError, Similarity, UpAxis};
pub use tcgs_codec::domain::*;
