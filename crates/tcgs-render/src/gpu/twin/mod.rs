//! CPU twins of the primitives: the kernels must reproduce them bit for bit.

mod owned;
mod permute;
mod probe;
mod scan;
mod sort;
#[cfg(test)]
mod tests;

pub use permute::part_of;
pub use probe::subgroup_probe;
pub use scan::{scan, scan_apply, scan_block_sums, scan_blocks, scan_partials, scan_reduce};
pub use sort::{
    radix_histogram, radix_scan, radix_scatter, radix_sort, sort_count, sort_offsets, sort_scatter,
};
