//! What these tests share with those of other crates.

#![allow(dead_code, unreachable_pub, reason = "a crate uses what it needs")]

#[path = "../../../../tests/it/support/gpu.rs"]
pub mod gpu;
#[path = "../../../../tests/it/support/oracle.rs"]
pub mod oracle;
#[path = "../../../../tests/it/support/random.rs"]
pub mod random;
#[path = "../../../../tests/it/support/scene.rs"]
pub mod scene;
#[path = "../../../../tests/it/support/sh.rs"]
pub mod sh;
#[path = "../../../../tests/it/support/shared.rs"]
pub mod shared;
#[path = "../../../../tests/it/support/skip.rs"]
pub mod skip;
#[path = "../../../../tests/it/support/tree.rs"]
pub mod tree;
