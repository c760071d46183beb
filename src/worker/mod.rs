//! Takes jobs from the queue and carries them out, in a process of its own.

pub mod run;
