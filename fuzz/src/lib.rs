//! The codec with the domain beneath it, compiled from the project's sources under the project's name: all that the
//! targets reach, and a small part of what the whole service would take to build with a sanitizer.

#![allow(missing_docs, dead_code, unreachable_pub, reason = "half of the domain is for other layers")]

#[path = "../../src/codec/mod.rs"]
pub mod codec;
#[path = "../../src/domain/mod.rs"]
pub mod domain;
