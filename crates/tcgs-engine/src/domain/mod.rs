//! Types that the engine and the service share: those of [`tcgs_codec::domain`], time, and points of failure.

mod causes;
pub mod clock;
pub mod failure_point;

pub use causes::{causes, is_no_space};
pub use clock::{Clock, ManualClock, SystemClock};
pub use failure_point::FailurePoint;
pub use tcgs_codec::domain::*;
