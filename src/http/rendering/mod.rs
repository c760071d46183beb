//! Pictures of scenes: rendered one at a time in a fair queue, encoded, and cached by all that decides their bytes.
//!
//! Nothing here knows a request's parameters or the handlers' state.

mod key;
mod picture;
mod queue;
mod view_renderer;

pub(super) use self::{
    key::{FrameSpec, RenderFrame, ViewKey},
    picture::{AnimationFormat, Format, Output, Picture, PictureKind, SettingError},
    queue::{Admission, QueueSlot},
    view_renderer::{Timing, ViewRenderer, failed},
};
