//! The rate term: bits in the stable form, quantized rows, the gradients of both, and networks as a file keeps them.

mod bits;
mod masks;
mod networks;
mod quantize;
mod scene;
mod stability;
mod term;
