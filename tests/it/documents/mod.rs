//! Documents and what operators copy: each holds true of the program.

mod citations;
mod container_image;
mod deployment;
pub(crate) mod examples;
mod problems;
