//! What several test modules share.
#![allow(dead_code, unreachable_pub, reason = "a test module uses what it needs")]

pub mod shared;
