//! What several test modules share.

#![allow(dead_code, unreachable_pub, reason = "a test module uses what it needs")]

pub mod authority;
pub mod balancer;
pub mod browser;
pub mod bucket;
pub mod contract;
pub mod cutter;
pub mod database;
pub mod dataset;
#[cfg(target_os = "linux")]
pub mod deployment;
pub mod eventually;
pub mod fakes;
pub mod faults;
pub mod faulty_bucket;
pub mod gate;
pub mod gpu;
#[cfg(target_os = "linux")]
pub mod io_faults;
pub mod lpips;
pub mod oracle;
#[cfg(unix)]
pub mod postgres;
pub mod program;
pub mod random;
pub mod receiver;
pub mod recorded;
pub mod scene;
pub mod server;
pub mod service;
pub mod sh;
pub mod shared;
pub mod skip;
pub mod small_disk;
pub mod sse;
pub mod totals;
pub mod tree;
