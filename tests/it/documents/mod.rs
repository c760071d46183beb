//! Documents and what operators copy: each holds true of the program.

mod citations;
mod command_line;
mod container_image;
mod deployment;
pub(crate) mod examples;
mod hardware;
mod links;
mod manifests;
mod problems;
mod retired_words;
mod scripts;
mod sentences;
mod us_spelling;
