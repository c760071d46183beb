//! The rate term: bits in the stable form, quantised rows, the gradients of both, and networks as a file keeps them.

mod bits;
mod masks;
mod networks;
mod quantise;
mod scene;
mod stability;
mod term;
