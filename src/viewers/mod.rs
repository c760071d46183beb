//! Views and exports by viewer processes (`tcgs viewer`), for API replicas without an adapter: the protocol between the two, the viewers
//! that a replica knows, and the announcement of a viewer.
//!
//! Invariants: while the viewers stay the same, a scene is always rendered by the same one, which has it in memory; a viewer that does not
//! answer is replaced only by one whose pictures have the same bits, so a picture's entity tag stays true; a viewer answers only who
//! knows its token, which is in the database alone.

mod announcement;
mod pool;
pub mod protocol;
mod remote;

pub use announcement::{ANNOUNCE_EVERY, announce};
pub use pool::{NoViewer, ViewerPool};
pub use remote::{RemoteEngine, export, renderer};
